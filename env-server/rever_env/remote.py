"""Environments that run in servers elsewhere, as Gymnasium environments."""

from dataclasses import asdict, replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from rever_env import protocol
from rever_env.arguments import (
    action_numbers,
    check_render_mode,
    image_size,
    layout_of,
    seed_of,
)
from rever_env.followed import CommandedPose, is_pose_controlled
from rever_env.remote_session import (
    Fleet,
    RemoteFault,
    RemoteRefused,
    RemoteSession,
    Wanted,
    opened,
)
from rever_env.spaces import RANDOM_SEEDS, action_space, metadata_of, observation_space

__all__ = ["RemoteEnv", "RemoteFault", "RemoteRefused"]

Fields = dict[str, Any]
Stepped = tuple[Fields, float, bool, bool, Fields]


class RemoteEnv(gymnasium.Env[Fields, NDArray[np.float32]], EzPickle):
    """One session of a server that speaks protocol/README.md, whatever simulator it is.

    Arguments
        connect: endpoints of servers or of a router, as tcp/HOST:PORT or HOST:PORT, or one of them.
        task: TASK or TASK/VARIANT; by default the first that the server offers. variant: instead
        of /VARIANT.
        image_height, image_width: pixels, 1 to 1024; 0 and 0 for no image.
        fleet: namespace of the servers. server: id of one of them; by default the least used.
        expert: info has "expert_action", float32, what the server's scripted expert would do.
        wait_secs: for a server with a free session (default: 30 s for a session to be free, but
        2 to 5 s for a server to be there). reply_secs: for a reply, also while the server is
        paused.

    Observation: image uint8 (height, width, 3), state float32 (n,), instruction text. Without
    images (0 x 0 pixels, or a server that has none) or numbers that part is left out, and
    without images render_mode is None.
    Action: float32 (n,), or a whole number where the task has a choice of actions. What the numbers
    are, session.task.state and session.task.action say; of a Bridge task see BridgeEnv.
    Reward, end of episodes and info: as the served environment has them. metadata["render_fps"] is
    its control rate. info has the flags of BridgeEnv; of other environments only is_success and
    ever_success are known.

    RemoteFault is raised when the environment or the way to it breaks, which is never a reward: the
    next reset begins a new episode, over a new session if need be, and finds a server that was
    started again. RemoteRefused is raised when the server refuses a request, ValueError for invalid
    arguments, gymnasium.error.ClosedEnvironmentError after close.
    Use it in one thread at a time, and in the process that made it: zenoh does not survive a fork.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium's form)

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
        wait_secs: float | None = None,
        reply_secs: float = 120.0,
    ) -> None:
        EzPickle.__init__(
            self,
            connect,
            task,
            variant,
            image_height,
            image_width,
            fleet=fleet,
            server=server,
            expert=expert,
            render_mode=render_mode,
            wait_secs=wait_secs,
            reply_secs=reply_secs,
        )
        self._is_closed = True
        check_render_mode(render_mode)
        height, width = image_size(image_height, image_width)
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
        self._fleet = Fleet(endpoints, fleet, server, wait_secs, reply_secs)
        self.session = opened(self._fleet, Wanted(task, variant, height, width, expert))
        self._is_closed = False
        told, sizes = self.session.task, self.session.opened
        self._wanted = Wanted(told.task, told.variant, height, width, expert)
        self._last: protocol.Observation | None = None
        self.metadata = metadata_of(told.control_hz)
        self.observation_space = observation_space(
            sizes.image_height, sizes.image_width, told.state
        )
        self.action_space: spaces.Space[Any] = action_space(told.action)
        self._names = set(self.observation_space.spaces)
        self.render_mode = render_mode if "image" in self._names else None
        self._commanded: CommandedPose | None = None

    def reset(
        self, *, seed: int | None = None, options: Fields | None = None
    ) -> tuple[Fields, Fields]:
        """Begins an episode; the same seed and options give the same one.

        seed: 0 to 2^53 - 1; None draws one. options: {"layout": 0..} for a fixed initial layout;
        otherwise the seed draws it. info: seed, and expert_action if it was asked for.
        """
        self.send_reset(seed, options)
        return self.receive_reset()

    def step(self, action: NDArray[np.float32]) -> Stepped:
        """One control step: observation, reward, terminated, truncated, info."""
        self.send_step(action)
        return self.receive_step()

    def render(self) -> NDArray[np.uint8] | None:
        """A copy of the last observation's image; None before the first reset."""
        if self.render_mode is None or self._last is None:
            return None
        return _image(self._last)

    def close(self) -> None:
        """Ends the session; a second call does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self.session.close()

    def send_reset(self, seed: int | None, options: Fields | None = None) -> None:
        """The first half of reset: returns before the server has answered."""
        self._require_open()
        layout, seed = layout_of(options), seed_of(seed)
        super().reset(seed=seed)  # seeds the stream that later resets draw from
        self._seed = int(self.np_random.integers(RANDOM_SEEDS)) if seed is None else seed
        if self.session.is_lost:
            self._open_again()
        task, numbered_seed = self.session.task, self._seed
        self.session.send(
            lambda sequence: protocol.Reset(
                sequence, task.task, task.variant, layout, numbered_seed
            )
        )

    def receive_reset(self) -> tuple[Fields, Fields]:
        """The second half: waits for the answer."""
        reply = self.session.receive()
        if not isinstance(reply, protocol.Observed):
            raise RemoteFault(f"expected Observed, got {type(reply).__name__}")
        observation = self._fields(reply.observation)
        told = self.session.task
        self._commanded = (
            CommandedPose(observation["state"])
            if is_pose_controlled(told.state, told.action)
            else None
        )
        return observation, {"seed": self._seed, **self._hints()}

    def send_step(self, action: NDArray[np.float32]) -> None:
        """The first half of step."""
        self._require_open()
        self._action = self.checked(action)
        numbers = tuple(self._action.reshape(-1).tolist())
        self.session.send(lambda sequence: protocol.Step(sequence, numbers))

    def checked(self, action: Any) -> NDArray[np.float32]:
        """The action's numbers; ValueError for others than the space has."""
        return action_numbers(self.action_space, action)

    def receive_step(self) -> Stepped:
        """The second half."""
        reply = self.session.receive()
        if not isinstance(reply, protocol.Stepped):
            raise RemoteFault(f"expected Stepped, got {type(reply).__name__}")
        transition = reply.transition
        observation = self._fields(transition.observation)
        info = {**asdict(transition.statistics), **self._hints()}
        if self._commanded is not None:
            info["action_followed"] = self._commanded.follow(self._action, observation["state"])
        return observation, transition.reward, transition.terminated, transition.truncated, info

    def _open_again(self) -> None:
        """Opens a session in place of the lost one, on whatever server is there now."""
        before = self.session
        before.close()
        self.session = RemoteSession(self._fleet, self._wanted, is_return=True)
        told, expected = self.session.task, before.task
        if replace(told, instruction=expected.instruction) != expected:
            self.session.close()
            raise RemoteFault(
                f"server {self.session.server}: expected task {expected.task} "
                f"({expected.variant}) as server {before.server} had described it, got another"
            )

    def _require_open(self) -> None:
        if self._is_closed:
            raise ClosedEnvironmentError("expected an open environment: close() was called")

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


def _image(observation: protocol.Observation) -> NDArray[np.uint8]:
    """Writable, and nobody else's."""
    image = observation.image
    pixels: NDArray[np.uint8] = np.array(np.frombuffer(image.pixels, np.uint8))
    return pixels.reshape(image.height, image.width, 3)
