"""openpi's own client against a policy server: plays recorded images, prints the actions it got.

Arguments: a JSON file {"address": "ws://HOST:PORT", "key": KEY or null, "side": S, "episodes": [
{"name": NAME or null, "images": [file of S x S x 3 bytes], "prompt": TEXT, "state": [numbers]}]}.
Every episode has its own connection; all play at once. Prints one JSON line: for each episode the
replies, each with the actions' bytes in hexadecimal, their shape, and the index of the chosen
candidate.
"""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def play(plan: dict[str, Any], episode: dict[str, Any]) -> list[dict[str, Any]]:
    """The replies to all images of an episode."""
    client = WebsocketClientPolicy(plan["address"], api_key=plan["key"])
    assert client.get_server_metadata()["rever"]["version"] == 1
    side = plan["side"]
    replies = []
    for path in episode["images"]:
        image = np.frombuffer(Path(path).read_bytes(), dtype=np.uint8).reshape(
            side, side, 3
        )
        observation: dict[str, Any] = {
            "observation/image": image,
            "observation/state": np.array(episode["state"], dtype=np.float32),
            "prompt": episode["prompt"],
        }
        if episode["name"] is not None:
            observation["rever"] = {"episode": episode["name"]}
        reply = client.infer(observation)
        actions = np.asarray(reply["actions"])
        assert actions.dtype == np.float32
        replies.append(
            {
                "actions": actions.tobytes().hex(),
                "shape": list(actions.shape),
                "chosen": reply["rever"]["chosen"],
                "infer_ms": reply["server_timing"]["infer_ms"],
            }
        )
    return replies


def main() -> None:
    """Plays all episodes at once."""
    plan = json.loads(Path(sys.argv[1]).read_text())
    episodes = plan["episodes"]
    with ThreadPoolExecutor(len(episodes)) as threads:
        print(
            json.dumps(list(threads.map(lambda episode: play(plan, episode), episodes)))
        )


if __name__ == "__main__":
    main()
