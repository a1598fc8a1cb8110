"""One session of a server: its numbered requests, its world, its saved states."""

import logging
import time
from typing import Any

import numpy as np

from rever_env import protocol, world
from rever_env.protocol import tiles
from rever_env.worlds import AnyWorld, Key, UnknownTask, Worlds

_log = logging.getLogger(__name__)

_SIMULATOR_US_MAX = 2**32 - 1  # the limit of the field, over an hour


class _Wrong(Exception):
    """The request is invalid at this moment; the world is unchanged."""


class Session:
    """Executes each request exactly once. Use it only in the simulation thread."""

    def __init__(
        self, opened: protocol.Open, worlds: Worlds, *, whole_images: bool = False
    ) -> None:
        self.steps = 0
        self.closed = False
        self._opened = opened
        self._whole_images = whole_images
        self._worlds = worlds
        self._last_sequence = 0
        self._last_reply = b""
        self._last_image = np.empty((0, 0, 3), np.uint8)  # of the last observation
        self._running = False
        self._slots: dict[int, Any] = {}
        worlds.task(opened.task, opened.variant)
        self._key: Key | None = self._key_of(opened.task, opened.variant)
        self._world: AnyWorld | None = worlds.take(self._key)

    def answer(self, data: bytes) -> bytes | None:
        """The bytes of the reply; None for a request that is older than the last one."""
        refusal = None
        try:
            request = protocol.REQUEST.decode(data)
        except protocol.CodecError as error:
            invalid = getattr(error, "message", None)
            if invalid is None or not 1 <= invalid.sequence < protocol.limits.SEED_END:
                return refused(0, str(error))
            request, refusal = invalid, str(error)
        sequence = request.sequence
        if sequence < self._last_sequence:
            return None
        if sequence == self._last_sequence:
            return self._last_reply
        expected = self._last_sequence + 1
        if sequence != expected:
            return refused(sequence, f"sequence: expected {expected}, got {sequence}")
        if refusal is not None:
            reply = refused(sequence, refusal)
        else:
            reply = self._perform(request)
        self._last_sequence, self._last_reply = sequence, reply
        return reply

    def end(self) -> None:
        """Closes the session and returns the world to the pool."""
        self.closed = True
        self._running = False
        self._slots.clear()
        self._release()

    def _perform(self, request: protocol.Request) -> bytes:
        sequence = request.sequence
        try:
            return protocol.REPLY.encode(self._reply(request))
        except (_Wrong, UnknownTask, world.InvalidAction, world.InvalidReset) as error:
            return refused(sequence, str(error))
        except world.PhysicsDiverged as error:
            return self._fault(sequence, protocol.FaultKind.PHYSICS_DIVERGED, str(error))
        except world.RendererUnavailable as error:
            return self._fault(sequence, protocol.FaultKind.RENDERER_UNAVAILABLE, str(error))
        except Exception as error:
            # A bug must reach the agent as a fault: silence or a default would become a label.
            _log.exception("request %d of a session failed", sequence)
            return self._fault(
                sequence, protocol.FaultKind.INTERNAL, f"{type(error).__name__}: {error}"
            )

    def _reply(self, request: protocol.Request) -> protocol.Reply:
        if self.closed:
            raise _Wrong(f"expected nothing after Close, got {type(request).__name__}")
        if isinstance(request, protocol.Reset):
            observation = self._reset(request)
            self._last_image = observation.image
            return protocol.Observed(request.sequence, self._observation(observation))
        if isinstance(request, protocol.Close):
            self.end()
            return protocol.Closed(request.sequence)
        if not self._running or self._world is None:
            raise _Wrong(f"expected Reset first, got {type(request).__name__}: no episode runs")
        if isinstance(request, protocol.Step):
            action = np.array(request.action, dtype=np.float64)
            begun = time.perf_counter()
            transition = self._world.step(action)
            simulator_us = min(int((time.perf_counter() - begun) * 1e6), _SIMULATOR_US_MAX)
            self.steps += 1
            return self._stepped(request.sequence, transition, simulator_us)
        if isinstance(request, protocol.Save):
            self._slots[request.slot] = self._world.save()
            return protocol.Saved(request.sequence)
        snapshot = self._slots.get(request.slot)
        if snapshot is None:
            raise _Wrong(f"slot: expected one of {sorted(self._slots)}, got {request.slot}")
        observation = self._world.restore(snapshot)
        self._last_image = observation.image
        return protocol.Restored(request.sequence, self._observation(observation))

    def _reset(self, request: protocol.Reset) -> world.Observation:
        self._worlds.task(request.task, request.variant)
        key = self._key_of(request.task, request.variant)
        if self._world is None or key != self._key:
            observation = self._change(key, request)
        else:
            observation = self._world.reset(layout=request.layout, seed=request.seed)
        self._slots.clear()
        self._running = True
        return observation

    def _change(self, key: Key, request: protocol.Reset) -> world.Observation:
        """Resets another world, which replaces this one; a refusal leaves this one unchanged."""
        fresh = self._worlds.take(key)
        try:
            observation = fresh.reset(layout=request.layout, seed=request.seed)
        except (world.InvalidAction, world.InvalidReset):
            self._worlds.give_back(key, fresh)
            raise
        except Exception:
            self._release()
            self._world, self._key = fresh, key  # closed by the fault
            raise
        self._release()
        self._world, self._key = fresh, key
        return observation

    def _fault(self, sequence: int, kind: protocol.FaultKind, reason: str) -> bytes:
        """Discards the world, which may be broken: the next Reset takes another one."""
        self._running = False
        self._slots.clear()
        if self._world is not None:
            self._worlds.discard(self._world)
        self._world = self._key = None
        return protocol.REPLY.encode(protocol.Faulted(sequence, kind, _short(reason)))

    def _release(self) -> None:
        if self._world is not None and self._key is not None:
            self._worlds.give_back(self._key, self._world)
        self._world = self._key = None

    def _key_of(self, task: str, variant: str) -> Key:
        return task, variant, self._opened.image_height, self._opened.image_width

    def _stepped(
        self, sequence: int, transition: world.Transition, simulator_us: int
    ) -> protocol.Stepped:
        image = transition.observation.image
        changes = None if self._whole_images else tiles.changes(self._last_image, image)
        self._last_image = image
        changed_tiles, pixels = changes or (None, image.tobytes())
        return protocol.Stepped(
            sequence,
            protocol.Transition(
                self._observation(transition.observation, pixels),
                transition.statistics,
                transition.reward,
                transition.terminated,
                transition.truncated,
            ),
            changed_tiles,
            simulator_us,
        )

    def _observation(
        self, observation: world.Observation, pixels: bytes | None = None
    ) -> protocol.Observation:
        """The observation as a message. pixels: those of the changed tiles; None for all."""
        height, width, _ = observation.image.shape
        expert_action = None
        if self._opened.expert and self._world is not None:
            action = self._world.expert_action().astype(np.float32)
            expert_action = tuple(action.tolist())
        return protocol.Observation(
            image=protocol.Image(
                height, width, observation.image.tobytes() if pixels is None else pixels
            ),
            state=tuple(observation.state.tolist()),
            instruction=observation.instruction,
            expert_action=expert_action,
        )


def refused(sequence: int, reason: str) -> bytes:
    """The bytes of a refusal."""
    return protocol.REPLY.encode(protocol.Refused(sequence, _short(reason)))


def _short(reason: str) -> str:
    """The text, truncated to the protocol's limit."""
    limit = protocol.limits.TEXT_BYTES_MAX
    return reason.encode()[:limit].decode(errors="ignore")
