"""Environments that run in servers elsewhere, as Gymnasium environments: one, and many at once."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray

from rever_env import protocol
from rever_env.remote_session import Fleet, RemoteFault, RemoteSession, holder
from rever_env.spaces import (
    RANDOM_SEEDS,
    action_space,
    check_render_mode,
    layout_of,
    observation_space,
)

Fields = dict[str, Any]
Stepped = tuple[Fields, float, bool, bool, Fields]


class RemoteEnv(gymnasium.Env[Fields, NDArray[np.float32]]):
    """One session of a server that speaks protocol/README.md, whatever simulator it is.

    connect: endpoints of servers or a router, as tcp/HOST:PORT, or one of them.
    task: by default the first that the server offers. variant: "default" of a named task.
    observation: image uint8 (height, width, 3), state float32 (n,), instruction text.
    action: float32 (n,), or a whole number where the task has a choice of actions. What the numbers
    are, session.task.state and session.task.action say; of a Bridge task see BridgeEnv. Without
    images (0 x 0 pixels, or a server that has none) or numbers that part of the observation is left
    out.
    reset options: {"layout": 0..} for a fixed layout; otherwise the seed draws one.
    expert: info has "expert_action", float32 (n,), what the server's scripted expert would do.
    wait_secs: for a server to be there; reply_secs: for a reply, whatever is sent again meanwhile.
    Raises RemoteFault when the world or the way to it breaks, which is never a reward, and
    RemoteRefused when the server refuses a request.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's form)

    def __init__(
        self,
        connect: str | tuple[str, ...],
        task: str | None = None,
        variant: str | None = None,
        image_height: int = 128,
        image_width: int = 128,
        *,
        fleet: str = "local",
        server: str | None = None,
        expert: bool = False,
        render_mode: str | None = "rgb_array",
        wait_secs: float = 30.0,
        reply_secs: float = 120.0,
    ) -> None:
        check_render_mode(render_mode)
        self.render_mode = render_mode
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect)

        def opening(description: protocol.Description) -> protocol.Open:
            side_max = description.image_side_max  # 0: it has no images
            first = description.tasks[0]
            return protocol.Open(
                protocol.PROTOCOL_VERSION,
                first.task if task is None else task,
                (first.variant if task is None else "default") if variant is None else variant,
                image_height if side_max else 0,
                image_width if side_max else 0,
                expert,
                holder(),
            )

        self.session = RemoteSession(
            Fleet(endpoints, fleet, server, wait_secs, reply_secs), opening
        )
        self._last: protocol.Observation | None = None
        self._is_closed = False
        self.observation_space = observation_space(
            self.session.opened.image_height,
            self.session.opened.image_width,
            self.session.task.instruction,
            self.session.task.state,
        )
        self._names = set(self.observation_space.spaces)
        if "image" not in self._names:
            self.render_mode = None
        self.action_space: spaces.Space[Any] = action_space(self.session.task.action)

    def reset(
        self, *, seed: int | None = None, options: Fields | None = None
    ) -> tuple[Fields, Fields]:
        self.send_reset(seed, options)
        return self.receive_reset()

    def step(self, action: NDArray[np.float32]) -> Stepped:
        self.send_step(action)
        return self.receive_step()

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None or self._last is None:
            return None
        return _image(self._last)

    def close(self) -> None:
        if not self._is_closed:
            self.session.close()
            self._is_closed = True

    def send_reset(self, seed: int | None, options: Fields | None = None) -> None:
        """The first half of reset: returns before the server has answered."""
        super().reset(seed=seed)  # seeds the stream that later resets draw from
        layout, task = layout_of(options), self.session.task
        self._seed = int(self.np_random.integers(RANDOM_SEEDS)) if seed is None else seed
        self.session.send(
            lambda sequence: protocol.Reset(sequence, task.task, task.variant, layout, self._seed)
        )

    def receive_reset(self) -> tuple[Fields, Fields]:
        """The second half: waits for the answer."""
        reply = self.session.receive()
        if not isinstance(reply, protocol.Observed):
            raise RemoteFault(f"expected Observed, got {type(reply).__name__}")
        return self._fields(reply.observation), {"seed": self._seed, **self._hints()}

    def send_step(self, action: NDArray[np.float32]) -> None:
        """The first half of step."""
        numbers = self.checked(action)
        self.session.send(lambda sequence: protocol.Step(sequence, numbers))

    def checked(self, action: NDArray[np.float32]) -> tuple[float, ...]:
        """The action's numbers; ValueError for others than the space has."""
        numbers = np.asarray(action, np.float32)
        if numbers.shape != self.action_space.shape:
            raise ValueError(
                f"action: expected shape {self.action_space.shape}, got {numbers.shape}"
            )
        if not np.isfinite(numbers).all():
            raise ValueError(f"action: expected finite numbers, got {numbers.tolist()}")
        return tuple(numbers.reshape(-1).tolist())

    def receive_step(self) -> Stepped:
        """The second half."""
        reply = self.session.receive()
        if not isinstance(reply, protocol.Stepped):
            raise RemoteFault(f"expected Stepped, got {type(reply).__name__}")
        transition = reply.transition
        observation = self._fields(transition.observation)
        info = {**asdict(transition.statistics), **self._hints()}
        return observation, transition.reward, transition.terminated, transition.truncated, info

    def _fields(self, observation: protocol.Observation) -> Fields:
        self._last = observation
        fields = {
            "image": _image(observation),
            "state": np.array(observation.state, np.float32),
            "instruction": observation.instruction,
        }
        return {name: value for name, value in fields.items() if name in self._names}

    def _hints(self) -> Fields:
        if self._last is None or self._last.expert_action is None:
            return {}
        return {"expert_action": np.array(self._last.expert_action, np.float32)}


class RemoteVectorEnv(VectorEnv[Fields, NDArray[np.float32], NDArray[Any]]):
    """Sessions of many servers, stepped at once: every request is out before any reply is read.

    connect: endpoints, each of a server or a router; environments are dealt out to them in turns,
    by default one to each. Other arguments as for RemoteEnv.
    autoreset_mode: as in gymnasium.vector. NEXT_STEP: the step after an episode's end begins the
    next one and ignores its action. SAME_STEP: the last step itself does, and the last observation
    is in info["final_obs"]. DISABLED: reset with options={"reset_mask": bool (environments,)}.
    """

    def __init__(
        self,
        connect: str | Sequence[str],
        num_envs: int | None = None,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ) -> None:
        endpoints = [connect] if isinstance(connect, str) else list(connect)
        self.num_envs = len(endpoints) if num_envs is None else num_envs
        if not endpoints or self.num_envs < 1:
            raise ValueError(
                f"expected endpoints and environments, got {len(endpoints)} and {self.num_envs}"
            )
        self.envs: list[RemoteEnv] = []
        try:
            for index in range(self.num_envs):
                self.envs.append(RemoteEnv(endpoints[index % len(endpoints)], **arguments))
        except BaseException:
            self.close_extras()
            raise
        first = self.envs[0]
        self.render_mode = first.render_mode
        self.autoreset_mode = autoreset_mode
        self.metadata = {**RemoteEnv.metadata, "autoreset_mode": autoreset_mode}
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, self.num_envs)
        self.action_space = batch_space(first.action_space, self.num_envs)
        self._ended = np.zeros(self.num_envs, np.bool_)
        self._latest: list[Fields] = [{}] * self.num_envs

    def reset(self, *, seed: Any = None, options: Fields | None = None) -> tuple[Fields, Fields]:
        """seed: the first of consecutive ones, or a list with one or None for each environment."""
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"reset_mask: expected bool ({self.num_envs},), got {mask.shape}")
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} seeds, got {len(seeds)}")
        for env, own, wanted in zip(self.envs, seeds, mask, strict=True):
            if wanted:
                env.send_reset(own, options)
        infos: Fields = {}
        for index, env in enumerate(self.envs):
            if mask[index]:
                self._latest[index], info = env.receive_reset()
                infos = self._add_info(infos, info, index)
        self._ended[mask] = False
        return self._batch(), infos

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Fields, NDArray[Any], NDArray[Any], NDArray[Any], Fields]:
        """actions: one for each environment."""
        if len(actions) != self.num_envs:
            raise ValueError(f"actions: expected {self.num_envs} of them, got {len(actions)}")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise ValueError(f"environments {ended} have ended: expected reset with a reset_mask")
        begins = self._ended.copy()
        for env, action, begin in zip(self.envs, actions, begins, strict=True):
            if not begin:
                env.checked(action)  # before any of them moves
        for env, action, begin in zip(self.envs, actions, begins, strict=True):
            if begin:
                env.send_reset(None)
            else:
                env.send_step(action)
        rewards = np.zeros(self.num_envs, np.float64)
        terminated, truncated = (np.zeros(self.num_envs, np.bool_) for _ in range(2))
        infos: Fields = {}
        for index, env in enumerate(self.envs):
            if begins[index]:
                self._latest[index], info = env.receive_reset()
            else:
                stepped = env.receive_step()
                self._latest[index], rewards[index] = stepped[0], stepped[1]
                terminated[index], truncated[index], info = stepped[2], stepped[3], stepped[4]
            infos = self._add_info(infos, info, index)
        self._ended = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            infos = self._begin_ended(infos)
        return self._batch(), rewards, terminated, truncated, infos

    def close_extras(self, **_arguments: Any) -> None:
        for env in self.envs:
            env.close()

    def _begin_ended(self, infos: Fields) -> Fields:
        ended = np.flatnonzero(self._ended).tolist()
        for index in ended:
            infos = self._add_info(infos, {"final_obs": self._latest[index]}, index)
            self.envs[index].send_reset(None)
        for index in ended:
            self._latest[index], info = self.envs[index].receive_reset()
            infos = self._add_info(infos, info, index)
        self._ended[:] = False
        return infos

    def _batch(self) -> Fields:
        empty: Any = create_empty_array(self.single_observation_space, self.num_envs)
        batched: Any = concatenate(self.single_observation_space, self._latest, empty)
        fields: Fields = batched
        return fields


def _image(observation: protocol.Observation) -> NDArray[np.uint8]:
    image = observation.image
    return np.frombuffer(image.pixels, np.uint8).reshape(image.height, image.width, 3)
