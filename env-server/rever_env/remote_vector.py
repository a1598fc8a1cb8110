"""RemoteVectorEnv: sessions of several servers as one Gymnasium vector, stepped at once."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from rever_env.arguments import seed_of
from rever_env.remote import Fields, RemoteEnv, RemoteFault, RemoteRefused

# Backoff: an attempt to reach a lost server delays all environments, so that the next attempt
# starts this many times the attempt's duration later.
_RETRY_FACTOR = 4.0


class RemoteVectorFault(RemoteFault):
    """Some environments of a vector have lost their episodes; the others are intact.

    faults: the RemoteFault of each lost environment, by its index.
    results: what the call would have returned. The rows of lost environments have their last
    observation, reward NaN, and the message in infos["fault"].
    """

    def __init__(self, faults: dict[int, RemoteFault], results: tuple[Any, ...]) -> None:
        words = "; ".join(f"environment {index}: {fault}" for index, fault in faults.items())
        super().__init__(words)
        self.faults = faults
        self.results = results


class RemoteVectorEnv(VectorEnv[Fields, NDArray[np.float32], NDArray[Any]]):
    """num_envs sessions of one or more servers. All requests are sent before any reply is read.

    Arguments:
        connect: endpoints of servers or routers. Environments are assigned to them in turn.
        num_envs: number of environments. Default: one per endpoint, or as many as the longest
            sequence of tasks or variants.
        task, variant: one for all environments, or a sequence with one for each.
        autoreset_mode: gymnasium.vector.AutoresetMode or its value. NEXT_STEP: the step after the
            end of an episode resets and ignores its action. SAME_STEP: the last step resets; the
            last observation and info are in infos["final_obs"] and infos["final_info"]. DISABLED:
            call reset with options={"reset_mask": bool (num_envs,)}.
        Other arguments: as for RemoteEnv.

    Observations and actions: those of RemoteEnv, batched along the first axis; instructions are a
    tuple of str. Rewards: float64 (num_envs,). terminated, truncated: bool (num_envs,). infos: the
    keys of RemoteEnv as arrays, each with a mask under "_KEY".

    Raises:
        RemoteVectorFault: some environments lost their episodes. It holds the results of the
            others, and the vector remains usable. While a server is unreachable, every step raises
            it again. With NEXT_STEP and SAME_STEP each step tries to reset the lost environments;
            with DISABLED, reset does.
        RemoteRefused: a server refused a request.
        ValueError: invalid arguments or actions; environments with different spaces.
    """

    def __init__(
        self,
        connect: str | Sequence[str],
        num_envs: int | None = None,
        *,
        task: str | Sequence[str] | None = None,
        variant: str | Sequence[str] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        self.envs: list[RemoteEnv] = []
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        endpoints = [connect] if isinstance(connect, str) else list(connect)
        lists = [
            list(one) for one in (task, variant) if one is not None and not isinstance(one, str)
        ]
        counts = [len(endpoints), *map(len, lists)]
        self.num_envs = max(counts) if num_envs is None else num_envs
        if not endpoints or self.num_envs < 1:
            raise ValueError(
                "expected at least one endpoint and one environment, got "
                f"{len(endpoints)} and {self.num_envs}"
            )
        try:
            for index in range(self.num_envs):
                self.envs.append(
                    RemoteEnv(
                        endpoints[index % len(endpoints)],
                        self._of("task", task, index),
                        self._of("variant", variant, index),
                        **arguments,
                    )
                )
            self._require_same_spaces()
        except BaseException:
            self.close_extras()
            raise
        first = self.envs[0]
        self.render_mode = first.render_mode
        self.metadata = {**first.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, self.num_envs)
        self.action_space = batch_space(first.action_space, self.num_envs)
        self._ended = np.zeros(self.num_envs, np.bool_)
        self._lost = np.zeros(self.num_envs, np.bool_)
        self._endpoints = [endpoints[index % len(endpoints)] for index in range(self.num_envs)]
        self._retry_at: dict[str, float] = {}  # by endpoint
        empty: Any = create_empty_array(self.single_observation_space, 1, fn=np.zeros)
        nothing = {name: value[0] for name, value in empty.items()}
        self._latest: list[Fields] = [nothing] * self.num_envs

    def reset(self, *, seed: Any = None, options: Fields | None = None) -> tuple[Fields, Fields]:
        """Resets all environments, or those of options["reset_mask"], bool (num_envs,).

        seed: an int, which gives environment i the seed + i, or a sequence with an int or None for
        each environment. options["layout"]: as in RemoteEnv.reset, for all of them.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"reset_mask: expected bool ({self.num_envs},), got {mask.dtype} {mask.shape}"
            )
        seeds = self._seeds(seed)
        call = _Call(self)
        call.send(_indices(mask), lambda index: self._send_reset(index, seeds[index], options))
        infos = self._received_resets(call, _indices(mask), {})
        results = self._batch(), infos
        call.finish(results)
        return results

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Fields, NDArray[Any], NDArray[Any], NDArray[Any], Fields]:
        """Executes one control step in every environment; see the class for what it returns."""
        if len(actions) != self.num_envs:
            raise ValueError(f"actions: expected {self.num_envs}, got {len(actions)}")
        is_manual = self.autoreset_mode == AutoresetMode.DISABLED
        if is_manual and self._ended.any():
            ended = _indices(self._ended)
            raise ValueError(
                f"environments {ended} have ended: call reset(options={{'reset_mask': mask}}) first"
            )
        begins = _indices(self._ended | self._lost) if not is_manual else []
        steps = _indices(~(self._ended | self._lost))
        rows = list(iterate(self.action_space, actions))
        for index in steps:
            self._check(index, rows[index])  # before any of them moves
        call = _Call(self)
        if is_manual:
            call.leave_out(_indices(self._lost))
        call.send(begins, lambda index: self._send_reset(index, None))
        call.send(steps, lambda index: self.envs[index].send_step(rows[index]))
        rewards = np.zeros(self.num_envs, np.float64)
        terminated, truncated = (np.zeros(self.num_envs, np.bool_) for _ in range(2))
        step_infos: dict[int, Fields] = {}

        def receive(index: int) -> None:
            stepped = self.envs[index].receive_step()
            self._latest[index], rewards[index] = stepped[0], stepped[1]
            terminated[index], truncated[index], step_infos[index] = stepped[2:]

        infos = self._received_resets(call, begins, {})
        call.receive(steps, receive)
        rewards[list(call.faults)] = np.nan
        self._ended = terminated | truncated
        infos = self._with_steps(call, step_infos, infos)
        results = self._batch(), rewards, terminated, truncated, infos
        call.finish(results)
        return results

    def render(self) -> tuple[Any, ...] | None:
        """The last image of each environment, uint8 (height, width, 3)."""
        if self.render_mode is None:
            return None
        return tuple(env.render() for env in self.envs)

    def call(self, name: str, *arguments: Any, **keywords: Any) -> tuple[Any, ...]:
        """The attribute of each environment; if it is callable, the result of calling it."""
        values = self.get_attr(name)
        return tuple(
            value(*arguments, **keywords) if callable(value) else value for value in values
        )

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The attribute of each environment."""
        return tuple(env.get_wrapper_attr(name) for env in self.envs)

    def set_attr(self, name: str, values: Any) -> None:
        """Sets an attribute of each environment. values: a list or tuple, or one value for all."""
        rows = values if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(rows) != self.num_envs:
            raise ValueError(f"{name}: expected {self.num_envs} values, got {len(rows)}")
        for env, value in zip(self.envs, rows, strict=True):
            env.set_wrapper_attr(name, value)

    def close_extras(self, **_arguments: Any) -> None:
        """Closes the environments."""
        for env in self.envs:
            env.close()

    def _with_steps(self, call: "_Call", step_infos: dict[int, Fields], infos: Fields) -> Fields:
        """Adds the infos of steps; with SAME_STEP, resets the environments that ended."""
        is_same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        ended = _indices(self._ended) if is_same_step else []
        for index, info in sorted(step_infos.items()):
            if index in ended:
                info = {"final_obs": self._latest[index], "final_info": info}
            infos = self._add_info(infos, info, index)
        self._ended[ended] = False
        call.send(ended, lambda index: self._send_reset(index, None))
        return self._received_resets(call, ended, infos)

    def _received_resets(self, call: "_Call", indices: list[int], infos: Fields) -> Fields:
        begun: dict[int, Fields] = {}

        def receive(index: int) -> None:
            self._latest[index], begun[index] = self.envs[index].receive_reset()

        call.receive(indices, receive)
        self._ended[list(begun)] = False
        self._lost[list(begun)] = False
        for index, info in begun.items():
            infos = self._add_info(infos, info, index)
        return infos

    def _send_reset(self, index: int, seed: int | None, options: Fields | None = None) -> None:
        env, endpoint = self.envs[index], self._endpoints[index]
        if not env.session.is_lost:
            env.send_reset(seed, options)
            return
        begun = time.monotonic()
        if begun < self._retry_at.get(endpoint, 0.0):
            raise RemoteFault(
                f"{endpoint}: the server is unreachable; the next attempt follows later"
            )
        try:
            env.send_reset(seed, options)
        except RemoteFault:
            now = time.monotonic()
            self._retry_at[endpoint] = now + _RETRY_FACTOR * (now - begun)
            raise

    def _check(self, index: int, action: Any) -> None:
        try:
            self.envs[index].checked(action)
        except ValueError as error:
            raise ValueError(f"environment {index}: {error}") from None

    def _seeds(self, seed: Any) -> list[int | None]:
        if seed is None or not np.iterable(seed):
            first = seed_of(seed)
            return [None if first is None else first + index for index in range(self.num_envs)]
        seeds = [seed_of(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} seeds, got {len(seeds)}")
        return seeds

    def _of(self, name: str, value: str | Sequence[str] | None, index: int) -> str | None:
        """The value of an argument for one environment."""
        if value is None or isinstance(value, str):
            return value
        if len(value) != self.num_envs:
            raise ValueError(f"{name}: expected one or {self.num_envs}, got {len(value)}")
        return value[index]

    def _require_same_spaces(self) -> None:
        first = self.envs[0]
        for index, env in enumerate(self.envs):
            for kind in ("observation_space", "action_space"):
                expected, found = getattr(first, kind), getattr(env, kind)
                if expected != found:
                    raise ValueError(
                        f"environment {index}, task {env.session.task.task}: {kind}: expected "
                        f"{expected} as environment 0, got {found}"
                    )

    def _batch(self) -> Fields:
        empty: Any = create_empty_array(self.single_observation_space, self.num_envs)
        batched: Any = concatenate(self.single_observation_space, self._latest, empty)
        fields: Fields = batched
        return fields


class _Call:
    """One call of all environments. A failure in one does not affect the replies of the others."""

    def __init__(self, vector: RemoteVectorEnv) -> None:
        self._vector = vector
        self.faults: dict[int, RemoteFault] = {}
        self._refusals: dict[int, RemoteRefused] = {}

    def send(self, indices: list[int], act: Callable[[int], None]) -> None:
        """Executes one half of a request for each environment that has not failed yet."""
        for index in indices:
            if index in self.faults or index in self._refusals:
                continue
            try:
                act(index)
            except RemoteFault as fault:
                self.faults[index] = fault
                self._vector._lost[index] = True
            except RemoteRefused as refusal:
                self._refusals[index] = refusal

    receive = send

    def leave_out(self, indices: list[int]) -> None:
        """Marks environments whose fault is already known."""
        for index in indices:
            self.faults[index] = RemoteFault("expected reset after a fault, got step")

    def finish(self, results: tuple[Any, ...]) -> None:
        """Raises what failed; a RemoteVectorFault holds the results of the other environments."""
        if self._refusals:
            index, refusal = next(iter(self._refusals.items()))
            raise RemoteRefused(f"environment {index}: {refusal}") from refusal
        if self.faults:
            infos = results[-1]
            for index, fault in self.faults.items():
                infos = self._vector._add_info(infos, {"fault": str(fault)}, index)
            raise RemoteVectorFault(self.faults, (*results[:-1], infos))


def _indices(mask: NDArray[np.bool_]) -> list[int]:
    return [int(index) for index in np.flatnonzero(mask)]
