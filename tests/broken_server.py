"""A server with defects for the conformance suite to find: `broken_server.py DEFECT[,DEFECT...] serve ...`."""

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from rever_env import __main__, protocol, server, session, world, worlds

Session: Any = session.Session
Server: Any = server.Server
World: Any = world.World
Worlds: Any = worlds.Worlds


def wrap(kind: Any, name: str) -> Callable[[Callable[..., Any]], None]:
    """Puts a function in the place of a method; it gets the method first, then the arguments."""
    original = getattr(kind, name)

    def put(function: Callable[..., Any]) -> None:
        setattr(kind, name, lambda *given, **named: function(original, *given, **named))

    return put


def sequence_of(data: bytes) -> int:
    try:
        return protocol.REQUEST.decode(data).sequence
    except protocol.CodecError:
        return 0


def repeats_twice() -> None:
    @wrap(Session, "answer")
    def answer(original: Any, self: Any, data: bytes) -> Any:
        if sequence_of(data) == self._last_sequence:
            self._last_sequence -= 1
        return original(self, data)


def answers_older() -> None:
    @wrap(Session, "answer")
    def answer(original: Any, self: Any, data: bytes) -> Any:
        reply = original(self, data)
        return self._last_reply if reply is None else reply


def jumps_gaps() -> None:
    @wrap(Session, "answer")
    def answer(original: Any, self: Any, data: bytes) -> Any:
        self._last_sequence = max(self._last_sequence, sequence_of(data) - 1)
        return original(self, data)


def drifts() -> None:
    count = itertools.count()

    @wrap(Session, "_reset")
    def reset(original: Any, self: Any, request: protocol.Reset) -> Any:
        return original(self, replace(request, seed=request.seed + 1000 * next(count)))


def breaks_first_reset() -> None:
    count = itertools.count()

    @wrap(Session, "_reset")
    def reset(original: Any, self: Any, request: protocol.Reset) -> Any:
        if next(count) == 0:
            raise world.PhysicsDiverged("made up")
        return original(self, request)


def changes_world_first() -> None:
    @wrap(Session, "_change")
    def change(_original: Any, self: Any, key: Any, request: protocol.Reset) -> Any:
        self._release()
        self._world, self._key = self._worlds.take(key), key
        return self._world.reset(layout=request.layout, seed=request.seed)


def any_variant() -> None:
    @wrap(Worlds, "task")
    def task(original: Any, self: Any, name: str, _variant: str) -> Any:
        return original(self, name, "default")


def one_seed() -> None:
    @wrap(Session, "_reset")
    def reset(original: Any, self: Any, request: protocol.Reset) -> Any:
        return original(self, replace(request, seed=0))


def forgets_command() -> None:
    @wrap(World, "restore")
    def restore(original: Any, self: Any, content: bytes) -> Any:
        observation = original(self, content)
        self.controller.reset(self.data)
        return observation


def never_ends() -> None:
    @wrap(World, "step")
    def step(original: Any, self: Any, action: Any) -> Any:
        return replace(original(self, action), truncated=False)


def keeps_leases() -> None:
    Server._end_abandoned = lambda self, as_of: None


def mute() -> None:
    Server._heartbeat = lambda self: protocol.Heartbeat("another", 0, 0, 0)


def any_version() -> None:
    protocol.OPEN._recognise = None
    original = protocol.Open.validate

    def validate(self: protocol.Open) -> None:
        original(replace(self, protocol=protocol.PROTOCOL_VERSION))

    protocol.Open.validate = validate  # type: ignore[method-assign]


def steps_unreset() -> None:
    @wrap(Session, "__init__")
    def init(original: Any, self: Any, *given: Any, **named: Any) -> None:
        original(self, *given, **named)
        self._world.reset(layout=None, seed=0)
        self._running = True


def no_limit() -> None:
    @wrap(Server, "_sessions")
    def sessions(original: Any, self: Any) -> int:
        return min(int(original(self)), self._options.sessions_max - 1)


def forgets_close() -> None:
    # Sessions end with their holders, soon enough for the rows that follow.
    server._HOLDER_SECS_MAX = 1.0

    @wrap(Session, "end")
    def end(original: Any, self: Any) -> None:
        self._running = False
        self._slots.clear()


def other_size() -> None:
    @wrap(Session, "__init__")
    def init(
        original: Any, self: Any, opened: protocol.Open, *given: Any, **named: Any
    ) -> None:
        original(
            self, replace(opened, image_height=opened.image_width), *given, **named
        )


def overstates_time() -> None:
    @wrap(Session, "_stepped")
    def stepped(original: Any, self: Any, *arguments: Any) -> Any:
        answer = original(self, *arguments)
        return replace(answer, simulator_us=answer.simulator_us * 1000)


def forgets_tile() -> None:
    @wrap(Session, "_stepped")
    def stepped(original: Any, self: Any, *arguments: Any) -> Any:
        answer = original(self, *arguments)
        if answer.changed_tiles:
            observation = answer.transition.observation
            pixels = observation.image.pixels[: -3 * protocol.limits.TILE_SIDE**2]
            observation = replace(
                observation, image=replace(observation.image, pixels=pixels)
            )
            transition = replace(answer.transition, observation=observation)
            tiles = answer.changed_tiles[:-1]
            answer = replace(answer, transition=transition, changed_tiles=tiles)
        return answer


def any_length() -> None:
    @wrap(World, "step")
    def step(original: Any, self: Any, action: Any) -> Any:
        return original(self, np.resize(np.append(action, 0.0), 7))


def never_opens() -> None:
    kept = []

    def open_(_self: Any, query: Any) -> Any:
        kept.append(query)
        raise Unanswered

    Server._open = open_
    ignore_unanswered()


def never_steps() -> None:
    @wrap(Session, "answer")
    def answer(original: Any, self: Any, data: bytes) -> Any:
        try:
            request = protocol.REQUEST.decode(data)
        except protocol.CodecError:
            return original(self, data)
        is_step = isinstance(request, protocol.Step)
        return None if is_step else original(self, data)


def describes_nonsense() -> None:
    Server._describe = lambda self, query: b"nonsense"


def answers_ahead() -> None:
    @wrap(Server, "_answer")
    def answer(original: Any, self: Any, lease: Any, request: Any) -> None:
        last = lease.session._last_reply
        before: Any = protocol.REPLY.decode(last) if last else None
        if isinstance(before, protocol.Stepped):
            transition = replace(before.transition, terminated=True)
            ahead = replace(before, sequence=before.sequence + 2, transition=transition)
            lease.outbox._publisher.put(protocol.REPLY.encode(ahead))
        original(self, lease, request)


class Unanswered(Exception):
    """Stands for a reply that is never sent."""


def ignore_unanswered() -> None:
    @wrap(Server, "_queryable")
    def queryable(original: Any, self: Any, key: str, answer: Any) -> Any:
        def put_query(work: Callable[[], None]) -> bool:
            def guarded() -> None:
                try:
                    work()
                except Unanswered:
                    pass

            return bool(put(guarded))

        put = self._inbox.put_query
        self._inbox.put_query = put_query
        return original(self, key, answer)


def beats_wildly() -> None:
    """Every second heartbeat cannot be read; the others tell of more memory each time."""
    sent, reported = itertools.count(), itertools.count()
    encode = protocol.HEARTBEAT.encode
    protocol.HEARTBEAT.encode = (  # type: ignore[method-assign]
        lambda message: b"nonsense" if next(sent) % 2 else encode(message)
    )

    @wrap(Server, "_heartbeat")
    def heartbeat(original: Any, self: Any) -> Any:
        return replace(
            original(self), resident_bytes=(1 + next(reported)) * 6_000_000_000
        )


DEFECTS = {
    function.__name__: function
    for function in (
        repeats_twice,
        answers_older,
        jumps_gaps,
        drifts,
        any_variant,
        one_seed,
        forgets_command,
        never_ends,
        keeps_leases,
        mute,
        any_version,
        steps_unreset,
        no_limit,
        forgets_close,
        other_size,
        forgets_tile,
        overstates_time,
        any_length,
        breaks_first_reset,
        changes_world_first,
        never_opens,
        never_steps,
        describes_nonsense,
        answers_ahead,
        beats_wildly,
    )
}

if __name__ == "__main__":
    for defect in sys.argv.pop(1).split(","):
        DEFECTS[defect]()
    sys.exit(__main__.main())
