"""Serves a checkpoint in PyTorch to policy clients: vla-eval's model server, or openpi's protocol.

python agent/training/serve.py --model DIR --wire vla-eval [--port 8001] [--temperature 0]

Needs torch, safetensors, tokenizers, and vla-eval or openpi-client. `serve.toml` is its profile for
`rever evaluate --policy vla-eval://127.0.0.1:8001 --policy-profile agent/training/serve.toml`.
"""

from __future__ import annotations

import argparse
import asyncio
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import checkpoint
from actions import DIMENSIONS
from generation import COMPLETION_TOKENS, decode, generate

LOOPBACK = "127.0.0.1"


class Policy:
    """A checkpoint as a function of image and instruction."""

    def __init__(self, model: Path, temperature: float, seed: int) -> None:
        self.checkpoint = checkpoint.read(model)
        self.temperature = temperature
        self.generator = torch.Generator().manual_seed(seed)

    def act(self, image: NDArray[np.uint8], instruction: str) -> NDArray[np.float32]:
        """(height, width, 3) -> 7: metres, rotation vector, gripper +1 open and -1 closed.

        Raises ValueError if the completion does not end in seven action tokens.
        """
        tokenizer = self.checkpoint.tokenizer
        completion = generate(
            self.checkpoint.network,
            torch.from_numpy(np.array(image))[None],
            torch.tensor([tokenizer.prompt(instruction)]),
            COMPLETION_TOKENS,
            self.temperature,
            self.generator,
        ).numpy()
        actions, well_formed = decode(self.checkpoint, completion)
        if not well_formed[0]:
            got = completion[0, -1 - DIMENSIONS :]
            raise ValueError(f"expected {DIMENSIONS} action tokens and the end, got {got}")
        result: NDArray[np.float32] = actions[0].astype(np.float32)
        return result


def serve_vla_eval(policy: Policy, port: int) -> None:
    """vla-eval's own model server; sessions and episodes are its business."""
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.model_servers.serve import serve
    from vla_eval.specs import IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA, DimSpec

    class Server(PredictModelServer):
        def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
            return {"actions": policy.act(obs["images"]["primary"], obs["task_description"])}

        def get_action_spec(self) -> dict[str, Any]:
            gripper = DimSpec("gripper", 1, "binary_close_negative", (-1, 1))
            return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": gripper}

        def get_observation_spec(self) -> dict[str, Any]:
            return {"image": IMAGE_RGB, "language": LANGUAGE}

    serve(Server(), host=LOOPBACK, port=port)


async def serve_openpi(policy: Policy, port: int) -> None:
    """openpi's protocol: metadata, then one result per observation; a text frame is an error."""
    from openpi_client import msgpack_numpy
    from websockets.asyncio.server import ServerConnection, serve

    async def answer(connection: ServerConnection) -> None:
        await connection.send(msgpack_numpy.packb({"model": "bridge-small in PyTorch"}))
        async for frame in connection:
            observation = msgpack_numpy.unpackb(frame)
            try:
                action = policy.act(observation["observation/image"], observation["prompt"])
            except (KeyError, ValueError):
                await connection.send(traceback.format_exc())
                await connection.close(1011, "the policy failed")
                return
            await connection.send(msgpack_numpy.packb({"actions": action[None]}))

    async with serve(answer, LOOPBACK, port, compression=None, max_size=None) as server:
        await server.serve_forever()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--wire", choices=["vla-eval", "openpi"], required=True)
    parser.add_argument("--port", type=int, default=8001)
    parser.add_argument("--temperature", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    policy = Policy(arguments.model, arguments.temperature, arguments.seed)
    if arguments.wire == "vla-eval":
        serve_vla_eval(policy, arguments.port)
    else:
        asyncio.run(serve_openpi(policy, arguments.port))


if __name__ == "__main__":
    main()
