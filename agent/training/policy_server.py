"""Serves a policy in Python to policy clients: openpi's protocol, or vla-eval's model server.

Over openpi the server announces the optional fields of agent/remote-policy/README.md: a client may
ask for several candidates at once and give their temperature and seed, so that a decision does not
depend on the order of requests or on the number of connections. vla-eval's server class cannot
announce them: its draws follow --seed in the order of the requests.

Needs openpi-client and websockets, or vla-eval.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import dataclasses
import hashlib
import random
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

LOOPBACK = "127.0.0.1"
CANDIDATES_MAX = 64
# The client's limit.
CHUNK_MAX = 1024
CLIENTS_MAX = 256
INSTRUCTION_CHARACTERS_MAX = 1024
FRAME_BYTES_MAX = 16 * 1024 * 1024
SEED_MAX = 2**64 - 1
# The key of the optional fields, and their version.
FIELDS = "rever"
FIELDS_VERSION = 1

# The actions of a candidate, (steps, dimensions), or why it has none.
Candidate = NDArray[np.float32] | str


@dataclass(frozen=True)
class Observation:
    """One observation of a client."""

    # (height, width, 3)
    image: NDArray[np.uint8]
    # The numbers of the robot's state; none if the client sends no state.
    state: NDArray[np.float32]
    instruction: str

    @classmethod
    def read(cls, image: object, state: object, instruction: object) -> Observation:
        """Raises ValueError for another kind of value."""
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
            raise ValueError(f"image: expected uint8 (height, width, 3), got {kind(image)}")
        numbers = np.zeros(0) if state is None else state
        if not isinstance(numbers, np.ndarray) or numbers.ndim != 1 or not is_number(numbers):
            raise ValueError(f"state: expected a list of numbers, got {kind(state)}")
        if not isinstance(instruction, str):
            raise ValueError(f"instruction: expected a text, got {kind(instruction)}")
        if len(instruction) > INSTRUCTION_CHARACTERS_MAX:
            raise ValueError(
                f"instruction: expected at most {INSTRUCTION_CHARACTERS_MAX} characters, "
                f"got {len(instruction)}"
            )
        return cls(image, np.asarray(numbers, dtype=np.float32), instruction)


@dataclass(frozen=True)
class Draw:
    """How many candidates are drawn, and how; equal draws of one observation are equal."""

    candidates: int
    temperature: float
    seed: int

    @classmethod
    def read(cls, fields: object, default: Draw) -> Draw:
        """The optional fields of a request; missing ones are as in `default`. Raises ValueError."""
        if not isinstance(fields, Mapping):
            raise ValueError(f"{FIELDS}: expected a map, got {kind(fields)}")
        candidates = fields.get("candidates", default.candidates)
        if type(candidates) is not int or not 1 <= candidates <= CANDIDATES_MAX:
            raise ValueError(f"candidates: expected 1 to {CANDIDATES_MAX}, got {candidates!r}")
        temperature = fields.get("temperature", default.temperature)
        if type(temperature) not in (int, float) or not 0.0 <= temperature < float("inf"):
            raise ValueError(f"temperature: expected a number of at least 0, got {temperature!r}")
        seed = fields.get("seed", default.seed)
        if type(seed) is not int or not 0 <= seed <= SEED_MAX:
            raise ValueError(f"seed: expected an integer from 0 to {SEED_MAX}, got {seed!r}")
        return cls(candidates, float(temperature), seed)


@dataclass(frozen=True)
class Description:
    """What a server announces of its policy."""

    name: str
    # Identity of the computation: the same weights in the same program.
    digest: str
    # The temperature of requests that name none.
    temperature: float
    # Whether temperature 0 is deterministic.
    is_greedy: bool
    # Height and width of the images that the policy sees.
    image_size: tuple[int, int]
    # The unit of each dimension of an action, for distances between candidates; may be unknown.
    action_scale: list[float] | None

    def metadata(self) -> dict[str, Any]:
        """openpi's first frame."""
        fields: dict[str, Any] = {
            "version": FIELDS_VERSION,
            "candidates_max": CANDIDATES_MAX,
            "greedy": self.is_greedy,
            "digest": self.digest,
            "image_size": list(self.image_size),
        }
        if self.action_scale is not None:
            fields["action_scale"] = np.array(self.action_scale, dtype=np.float32)
        return {"model": self.name, FIELDS: fields}


class Policy(Protocol):
    """A policy that can be served."""

    @property
    def description(self) -> Description: ...

    def act(self, observation: Observation, draw: Draw) -> list[Candidate]:
        """One candidate for each that is asked for. Raises ValueError for a wrong observation."""
        ...


@dataclass(frozen=True)
class Options:
    """The options that every server has."""

    wire: str
    port: int
    seed: int
    temperature: float | None
    chunk: int | None
    threads: int

    @staticmethod
    def declare(parser: argparse.ArgumentParser) -> None:
        add = parser.add_argument
        add("--wire", choices=["openpi", "vla-eval"], default="openpi", help="(default: openpi)")
        add("--port", type=port, default=8001, help="on 127.0.0.1; 0 is any (default: 8001)")
        add("--seed", type=int, default=0, help="of draws whose client gives none (default: 0)")
        add("--temperature", type=float, help="of draws whose client gives none")
        add("--chunk", type=positive, help="actions of a chunk that are used (default: all)")
        add("--threads", type=positive, default=1, help="CPU threads (default: 1)")

    @classmethod
    def of(cls, arguments: argparse.Namespace) -> Options:
        return cls(**{name: getattr(arguments, name) for name in cls.__dataclass_fields__})


class Responder:
    """Answers observations one by one with the actions of a policy."""

    def __init__(self, policy: Policy, options: Options) -> None:
        self.policy = policy
        self.options = options
        self.description = policy.description
        if options.chunk is not None:
            # Fewer actions of a chunk are another policy.
            settings = f"{policy.description.digest} chunk {options.chunk}"
            digest = hashlib.sha256(settings.encode()).hexdigest()
            self.description = dataclasses.replace(policy.description, digest=digest)
        self.seeds = random.Random(options.seed)

    def default(self) -> Draw:
        """One candidate with the next seed of this server."""
        temperature = self.options.temperature
        if temperature is None:
            temperature = self.description.temperature
        return Draw(1, temperature, self.seeds.getrandbits(64))

    def candidates(self, observation: Observation, draw: Draw) -> list[Candidate]:
        found = self.policy.act(observation, draw)
        return [one if isinstance(one, str) else one[: self.options.chunk] for one in found]

    def action(self, observation: Observation) -> NDArray[np.float32]:
        """One chunk, (steps, dimensions). Raises ValueError if there is none."""
        (candidate,) = self.candidates(observation, self.default())
        if isinstance(candidate, str):
            raise ValueError(candidate)
        return candidate

    def openpi(self, fields: object) -> dict[str, Any]:
        """The answer to an observation of openpi. Raises ValueError."""
        if not isinstance(fields, Mapping):
            raise ValueError(f"observation: expected a map, got {kind(fields)}")
        image, prompt = (item(fields, key) for key in ("observation/image", "prompt"))
        observation = Observation.read(image, fields.get("observation/state"), prompt)
        if FIELDS not in fields:
            return {"actions": self.action(observation)}
        found = self.candidates(observation, Draw.read(fields[FIELDS], self.default()))
        first = next((index for index, one in enumerate(found) if not isinstance(one, str)), None)
        answer = {
            "candidates": [
                {"malformed": one} if isinstance(one, str) else {"actions": one} for one in found
            ],
            "digest": self.description.digest,
        }
        if first is None:
            # The wire has actions in every answer; a client that reads the fields ignores them.
            return {"actions": np.zeros((1, 1), np.float32), FIELDS: answer}
        return {"actions": found[first], FIELDS: {"chosen": first, **answer}}


def serve(policy: Policy, options: Options) -> None:
    """Serves until the process is ended. Prints a line that begins with `ready ws://HOST:PORT`."""
    wires = {"openpi": serve_openpi, "vla-eval": serve_vla_eval}
    place = f"{LOOPBACK}:{options.port}"
    with contextlib.suppress(KeyboardInterrupt):
        try:
            asyncio.run(wires[options.wire](Responder(policy, options)))
        except (OSError, ImportError) as error:
            text = f"error: cannot serve {options.wire} on {place}: {error}"
            raise SystemExit(text) from error


async def serve_openpi(responder: Responder) -> None:
    """openpi's protocol: metadata, then one result per observation; a text frame is an error."""
    from openpi_client import msgpack_numpy
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed

    description, options = responder.description, responder.options

    def respond(frame: bytes | str) -> bytes:
        try:
            fields = msgpack_numpy.unpackb(frame)
        except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
            raise ValueError(f"observation: expected a MessagePack map: {error!r}") from error
        result: bytes = msgpack_numpy.packb(responder.openpi(fields))
        return result

    async def answer(connection: ServerConnection) -> None:
        if len(server.connections) > CLIENTS_MAX:
            await connection.close(1013, f"expected at most {CLIENTS_MAX} clients")
            return
        # A client may end its connection at any time.
        with contextlib.suppress(ConnectionClosed):
            await converse(connection)

    async def converse(connection: ServerConnection) -> None:
        await connection.send(msgpack_numpy.packb(description.metadata()))
        async for frame in connection:
            try:
                reply = await asyncio.get_running_loop().run_in_executor(worker, respond, frame)
            except ValueError as error:
                await connection.send(str(error))
                await connection.close(1011, "the observation was refused")
                return
            await connection.send(reply)

    # One thread: PyTorch uses the cores, and what a client gets must not depend on the others.
    with ThreadPoolExecutor(1) as worker:
        limits = {"compression": None, "max_size": FRAME_BYTES_MAX, "max_queue": 1}
        async with serve(answer, LOOPBACK, options.port, **limits) as server:
            place = server.sockets[0].getsockname()[1]
            print(f"ready ws://{LOOPBACK}:{place} openpi, {description.name}", flush=True)
            await server.serve_forever()


async def serve_vla_eval(responder: Responder) -> None:
    """vla-eval's own model server, which keeps sessions and plays the chunks."""
    import anyio
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.model_servers.serve import serve_async
    from vla_eval.specs import IMAGE_RGB, LANGUAGE, POSITION_DELTA, RAW, ROTATION_AA, DimSpec

    class Server(PredictModelServer):
        def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
            images = item(obs, "images")
            image, prompt = item(images, "primary"), item(obs, "task_description")
            actions = responder.action(Observation.read(image, obs.get("states"), prompt))
            # A single action needs no buffer.
            return {"actions": actions[0] if len(actions) == 1 else actions}

        def get_action_spec(self) -> dict[str, Any]:
            gripper = DimSpec("gripper", 1, "binary_close_negative", (-1, 1))
            return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": gripper}

        def get_observation_spec(self) -> dict[str, Any]:
            return {"image": IMAGE_RGB, "language": LANGUAGE, "state": RAW}

        def get_observation_params(self) -> dict[str, Any]:
            return {"send_state": True}

    description, options = responder.description, responder.options
    server = Server(chunk_size=options.chunk or CHUNK_MAX)
    async with anyio.create_task_group() as group:
        place = await group.start(serve_async, server, LOOPBACK, options.port)
        print(f"ready ws://{LOOPBACK}:{place} vla-eval, {description.name}", flush=True)


def digest_of(folder: Path, names: list[str], settings: str = "") -> str:
    """SHA-256 of files of a folder and of settings that change its actions, in hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(names):
        content = (folder / name).read_bytes()
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    digest.update(settings.encode())
    return digest.hexdigest()


def item(fields: Mapping[str, Any], key: str) -> Any:
    if key not in fields:
        raise ValueError(f"observation: expected {key}, got {', '.join(map(str, fields))}")
    return fields[key]


def is_number(array: NDArray[Any]) -> bool:
    return array.dtype.kind in "iuf"


def kind(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return type(value).__name__


def port(text: str) -> int:
    number = int(text)
    if not 0 <= number < 65536:
        raise argparse.ArgumentTypeError(f"expected 0 to 65535, got {text}")
    return number


def positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {text}")
    return number
