"""RemoteEnv: an environment of a server in another process, as a Gymnasium environment."""

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
    """One session of an environment server that implements protocol/README.md, of any simulator.

    Arguments:
        connect: endpoint of a server or router, tcp/HOST:PORT or HOST:PORT, or a tuple of them.
        task: TASK or TASK/VARIANT. Default: the first task that the server offers.
        variant: the variant, instead of /VARIANT in task.
        image_height, image_width: pixels, 1 to 1024 each; 0 and 0 for no image.
        fleet: namespace; only servers of the same fleet are found.
        server: id of one server. Default: the server with the most free sessions.
        expert: add "expert_action", the action of the server's scripted expert, to every info.
        render_mode: "rgb_array", or None for an environment whose render() returns None.
        wait_secs: timeout in seconds for a server with a free session. Default: 2 s while
            connections are refused, 5 s while no server is found, 30 s while no session is free.
        reply_secs: timeout in seconds for one reply, including the time that a server is paused.

    Observation (dict):
        image: uint8 (image_height, image_width, 3), RGB. Absent for 0 x 0 pixels or for a task
            without images; render_mode is None then.
        state: float32 (n,). Absent for a task without numbers.
        instruction: str.

    Action: float32 (n,); an int (Discrete) or int64 (n,) (MultiDiscrete) for discrete actions.
    session.task.state and session.task.action name each number with its bounds. For Bridge tasks
    the units are those of BridgeEnv.

    Control rate: metadata["render_fps"] in steps per second of simulated time, if it is known.
    Reward, termination and truncation: those of the served environment.

    Info of step(): the flags of BridgeEnv. Of environments other than the Bridge tasks only
    is_success and ever_success are known: source_on_target equals is_success, and the other flags
    are False. action_followed exists only where state and action are those of a Bridge task.
    Info of reset(): seed, int. With expert=True both have expert_action, float32 (n,).

    Raises:
        RemoteFault: the environment or the connection broke. It is never a reward. reset() begins a
            new episode; if the session is lost, it opens another, on a restarted server too.
        RemoteRefused: the server refused a request, for an unknown task or layout for instance.
        ValueError: invalid arguments or actions.
        gymnasium.error.ClosedEnvironmentError: used after close().

    Use it from one thread at a time, and only in the process that created it: zenoh does not
    survive a fork.
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
        """Begins an episode. The same seed and options give the same episode.

        seed: 0 to 2^53 - 1; None draws one. options: {"layout": K} selects the fixed initial layout
        K; without it the seed draws a random layout.
        """
        self.send_reset(seed, options)
        return self.receive_reset()

    def step(self, action: NDArray[np.float32]) -> Stepped:
        """Executes one control step; see the class for what it returns."""
        self.send_step(action)
        return self.receive_step()

    def render(self) -> NDArray[np.uint8] | None:
        """The image of the last observation, uint8 (height, width, 3), as a copy.

        None before the first reset, without images, or with render_mode None.
        """
        if self.render_mode is None or self._last is None:
            return None
        return _image(self._last)

    def close(self) -> None:
        """Closes the session; a second call does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self.session.close()

    def send_reset(self, seed: int | None, options: Fields | None = None) -> None:
        """The first half of reset(): sends the request and returns before the server replies."""
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
        """The second half of reset(): waits for the reply."""
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
        """The first half of step(): sends the request and returns before the server replies."""
        self._require_open()
        self._action = self.checked(action)
        numbers = tuple(self._action.reshape(-1).tolist())
        self.session.send(lambda sequence: protocol.Step(sequence, numbers))

    def checked(self, action: Any) -> NDArray[np.float32]:
        """The action as an array; ValueError if it does not fit the action space."""
        return action_numbers(self.action_space, action)

    def receive_step(self) -> Stepped:
        """The second half of step(): waits for the reply."""
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
        """Opens a session in place of the lost one, on any server that offers the task now."""
        before = self.session
        before.close()
        self.session = RemoteSession(self._fleet, self._wanted, is_return=True)
        told, expected = self.session.task, before.task
        if replace(told, instruction=expected.instruction) != expected:
            self.session.close()
            raise RemoteFault(
                f"server {self.session.server}: expected the task {expected.task}/"
                f"{expected.variant} as server {before.server} described it, got another"
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
    """The image as a writable copy, uint8 (height, width, 3)."""
    image = observation.image
    pixels: NDArray[np.uint8] = np.array(np.frombuffer(image.pixels, np.uint8))
    return pixels.reshape(image.height, image.width, 3)
