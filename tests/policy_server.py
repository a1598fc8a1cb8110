"""A policy that follows its observations, behind vla-eval's model server or openpi's protocol.

Usage: python tests/policy_server.py vla-eval|openpi CHUNK

Prints `ready PORT`. The policy plans CHUNK actions from an observation: it moves up and opens the
gripper, at a speed that depends on the image and the state, so that another observation, another
order or another session gives other actions.
"""

import asyncio
import sys
from typing import Any

import anyio
import numpy as np
from openpi_client import msgpack_numpy
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async
from websockets.asyncio.server import ServerConnection, serve

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
        {"vla-eval": serve_vla_eval, "openpi": serve_openpi}[sys.argv[1]](
            int(sys.argv[2])
        )
    )
