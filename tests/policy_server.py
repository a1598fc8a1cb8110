"""A policy that follows its observations, behind vla-eval's model server or openpi's protocol.

Usage: python tests/policy_server.py vla-eval|openpi|drawn CHUNK

With `drawn` it is served by agent/training/policy_server.py, and its candidates differ by noise.
Prints `ready PORT`; `drawn` prints `ready ws://HOST:PORT`. The policy plans CHUNK actions from an observation: it moves up and opens the
gripper, at a speed that depends on the image and the state, so that another observation, another
order or another session gives other actions.
"""

import asyncio
import sys
from pathlib import Path
from typing import Any

import anyio
import numpy as np
from openpi_client import msgpack_numpy
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async
from websockets.asyncio.server import ServerConnection, serve

# Before this folder on the path: `import policy_server` would otherwise import this file.
sys.path.insert(0, str(Path(__file__).parent.parent / "agent/training"))
import policy_server as served

LOOPBACK = "127.0.0.1"


def plan(image: np.ndarray, state: np.ndarray, chunk: int) -> np.ndarray:
    """(height, width, 3), (8,) -> (chunk, 7)."""
    speed = (image.astype(np.float64).mean() / 255 + abs(float(state[2]))) * 0.01
    actions = np.zeros((chunk, 7), dtype=np.float32)
    actions[:, 2] = speed / np.arange(1, chunk + 1)
    actions[:, 6] = 1.0
    return actions


class Server(PredictModelServer):
    """The chunk is kept by vla-eval, which answers an observation with one action of it."""

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        return {
            "actions": plan(obs["images"]["primary"], obs["states"], self.chunk_size)
        }


class Drawn:
    """Candidates whose speed depends on the seed and the temperature."""

    description = served.Description("scripted", "0" * 64, 1.0, True, (64, 64), None)

    def __init__(self, chunk: int) -> None:
        self.chunk = chunk

    def act(
        self, observation: served.Observation, draw: served.Draw
    ) -> list[served.Candidate]:
        planned = plan(observation.image, observation.state, self.chunk)
        generator = np.random.default_rng(draw.seed)
        noise = draw.temperature * generator.normal(0, 0.002, (draw.candidates, 3))
        candidates = np.tile(planned, (draw.candidates, 1, 1))
        candidates[:, :, :3] += noise[:, None]
        return list(candidates)


async def serve_drawn(chunk: int) -> None:
    options = served.Options("openpi", 0, 0, None, None, 1)
    await served.serve_openpi(served.Responder(Drawn(chunk), options))


async def serve_vla_eval(chunk: int) -> None:
    async with anyio.create_task_group() as group:
        port = await group.start(serve_async, Server(chunk_size=chunk), LOOPBACK, 0)
        print(f"ready {port}", flush=True)


async def serve_openpi(chunk: int) -> None:
    async def answer(connection: ServerConnection) -> None:
        await connection.send(msgpack_numpy.packb({}))
        async for frame in connection:
            observation = msgpack_numpy.unpackb(frame)
            actions = plan(
                observation["observation/image"],
                observation["observation/state"],
                chunk,
            )
            await connection.send(msgpack_numpy.packb({"actions": actions}))

    async with serve(answer, LOOPBACK, 0, compression=None, max_size=None) as server:
        print(f"ready {server.sockets[0].getsockname()[1]}", flush=True)
        await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(
        {
            "vla-eval": serve_vla_eval,
            "openpi": serve_openpi,
            "drawn": serve_drawn,
        }[sys.argv[1]](int(sys.argv[2]))
    )
