"""robosuite's environments behind the protocol: any of its tasks with any of its robots."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import tasks
from rever_env.fault import InvalidAction, InvalidReset, PhysicsDiverged
from rever_env.layout import check_layout
from rever_env.pose import in_base
from rever_env.protocol import Dimension, Statistics
from rever_env.success import success_alone
from rever_env.world import DOWN, Observation, Transition, broken, silence_warnings

# What robosuite's documentation says each task is about.
_INSTRUCTIONS = {
    "Lift": "lift the cube",
    "Stack": "stack the red cube on the green cube",
    "PickPlace": "put every object into its bin",
    "PickPlaceCan": "put the can into its bin",
    "PickPlaceBread": "put the bread into its bin",
    "PickPlaceCereal": "put the cereal into its bin",
    "PickPlaceMilk": "put the milk into its bin",
    "NutAssembly": "put both nuts on their pegs",
    "NutAssemblySquare": "put the square nut on its peg",
    "NutAssemblyRound": "put the round nut on its peg",
    "Door": "open the door",
    "Wipe": "wipe the table",
    "ToolHang": "hang the tool on the frame",
}
# An object's own values, not what it refers to: numbers, and containers of them.
_PLAIN = (np.ndarray, np.generic, float, int, bool, str, type(None))


@dataclass(frozen=True)
class RobosuiteTask:
    """A task of robosuite with a robot, which is the protocol's variant; or a Bridge task in it."""

    name: str
    variant: str
    instruction: str
    steps_max: int
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]
    making: Mapping[str, Any]  # for robosuite.make
    control_hz: float
    camera: str = "agentview"
    version: int = 1
    layouts: tuple[Any, ...] = ()  # robosuite draws every layout of its own tasks
    is_bridge: bool = False
    is_one_arm: bool = True


def offered(
    names: Sequence[str], robots: Sequence[str], steps_max: int, control_hz: float
) -> dict[str, RobosuiteTask]:
    """Every named task with every named robot; InvalidReset for an unknown name.

    robots: ROBOT, or ROBOT+ROBOT for a task of two. A Bridge task has its own robot, horizon and
    rate of control.
    """
    import robosuite

    bridge = tasks.load()
    own = {name: _bridge(bridge[name]) for name in names if name in bridge}
    names = [name for name in names if name not in own]
    for kind, given, known in (
        ("task", names, {*robosuite.ALL_ENVIRONMENTS, *bridge}),
        ("robot", [one for some in robots for one in some.split("+")], robosuite.ALL_ROBOTS),
    ):
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise InvalidReset(f"{kind}s {unknown}: expected some of {sorted(known)}")
    return own | {
        f"{name}/{robot}": _task(
            name,
            robot,
            steps_max,
            {"env_name": name, "robots": robot.split("+"), "control_freq": control_hz},
        )
        for name in names
        for robot in robots
    }


def _task(name: str, robot: str, steps_max: int, making: Mapping[str, Any]) -> RobosuiteTask:
    """One arm with a gripper has what a Bridge task has; others, robosuite's own numbers."""
    import robosuite

    try:
        environment = robosuite.make(
            **making, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False
        )
    except (AssertionError, ValueError) as error:
        raise InvalidReset(f"task {name} with {robot}: {error}") from error
    is_one_arm = len(environment.robots) == 1 and environment.action_dim == 7
    if is_one_arm:
        bridge = next(iter(tasks.load().values()))
        state, action = bridge.state, bridge.action
    else:
        low, high = environment.action_spec
        action = tuple(
            Dimension(f"action[{index}]", float(bounds[0]), float(bounds[1]), False)
            for index, bounds in enumerate(zip(low, high, strict=True))
        )
        state = tuple(
            Dimension(f"{part}[{index}]", None, None, False)
            for part, numbers in _felt(environment.reset())
            for index in range(len(numbers))
        )
    environment.close()
    return RobosuiteTask(
        name,
        robot,
        _INSTRUCTIONS.get(name, name),
        steps_max,
        state,
        action,
        making,
        float(making["control_freq"]),
        is_one_arm=is_one_arm,
    )


def _felt(observation: Mapping[str, Any]) -> list[tuple[str, NDArray[np.float64]]]:
    """What each robot feels of itself, by its name."""
    ending = "_proprio-state"
    return [
        (name.removesuffix(ending), np.asarray(observation[name]))
        for name in sorted(observation)
        if name.endswith(ending)
    ]


def _bridge(task: tasks.Task) -> RobosuiteTask:
    from rever_env import robosuite_bridge

    return RobosuiteTask(
        task.name,
        task.variant,
        task.instruction,
        task.steps_max,
        task.state,
        task.action,
        {"env_name": robosuite_bridge.ENVIRONMENTS[task.name]},
        task.control_hz,
        robosuite_bridge.CAMERA,
        task.version,
        task.layouts,
        is_bridge=True,
    )


def simulator() -> str:
    """Its name with its version."""
    return f"robosuite {metadata.version('robosuite')}"


class RobosuiteWorld:
    """One robosuite environment with its default controller.

    Not thread-safe: use it in the thread that made it. One arm is driven like a Bridge task's, in
    metres and radians in the base's frame; moves beyond the controller's limit per step are cut, as
    robosuite does. Other robots take robosuite's own actions. Statistics of its own tasks know
    success alone.
    """

    def __init__(self, task: RobosuiteTask, image_height: int, image_width: int) -> None:
        import robosuite

        silence_warnings()
        self.task = task
        self._size = (image_height, image_width)
        has_image = self._size != (0, 0)
        cameras = (
            {"camera_heights": image_height, "camera_widths": image_width} if has_image else {}
        )
        self._environment: Any = robosuite.make(
            **task.making,
            has_renderer=False,
            has_offscreen_renderer=has_image,
            use_camera_obs=has_image,
            camera_names=task.camera,
            ignore_done=True,
            # Some models are drawn, too (a cube's size): the same one for every world, for a new
            # one at each reset would cost a second.
            hard_reset=False,
            seed=0,
            **cameras,
        )
        self._robot = self._environment.robots[0]
        if task.is_one_arm:
            arm = self._robot.part_controllers[self._robot.arms[0]]
            self._scale = np.asarray(arm.output_max, np.float64)
        self._steps: int | None = None
        self._ever_success = False
        self._last: Observation | None = None

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """The same seed gives the same bytes: robosuite's generators are set again in place."""
        environment = self._environment
        check_layout(self.task.name, layout, len(self.task.layouts))
        self._make_current()
        if self.task.is_bridge:
            observation = environment.begin(layout, seed)
        else:
            self._seed(seed)
            observation = environment.reset()
        self._check_physics(0)
        self._steps, self._ever_success = 0, False
        return self._observe(observation)

    def _seed(self, seed: int) -> None:
        # 1.5.2 ignores the seed that its Gymnasium wrapper is given; the layout sampler keeps
        # the generator object, so that its state is what must be replaced.
        state = np.random.default_rng(seed).bit_generator.state
        self._environment.rng.bit_generator.state = state
        np.random.seed(seed % 2**32)

    def step(self, action: NDArray[np.float64]) -> Transition:
        """action: float64, as the task describes; of one arm (7,): dx dy dz (m), rotation vector

        (rad), gripper (+1 open).
        """
        steps = self._running()
        if steps >= self.task.steps_max:
            raise InvalidAction(f"step {steps + 1}: expected at most {self.task.steps_max}")
        self._make_current()
        count = len(self.task.action)
        if action.shape != (count,):
            raise InvalidAction(f"action: expected shape ({count},), got {action.shape}")
        if self.task.is_one_arm:
            # robosuite's gripper closes at +1.
            command = np.concatenate([action[:6] / self._scale, [-action[6]]])
            command = np.clip(command, -1.0, 1.0)
        else:
            command = np.clip(action, *self._environment.action_spec)
        observation, reward, _, _ = self._environment.step(command)
        self._steps = steps + 1
        self._check_physics(self._steps)
        return Transition(
            observation=self._observe(observation),
            statistics=self._judged(),
            reward=float(reward),
            terminated=False,
            truncated=self._steps >= self.task.steps_max,
        )

    def _check_physics(self, steps: int) -> None:
        sim = self._environment.sim
        words = broken(sim.model._model, sim.data._data)
        if words:
            self._steps = None
            raise PhysicsDiverged(f"physics of {self.task.name} at step {steps}: {words}")

    def _judged(self) -> Statistics:
        """Of its own tasks robosuite knows success alone."""
        if self.task.is_bridge:
            statistics: Statistics = self._environment.judged()
            return statistics
        is_success = bool(self._environment._check_success())
        self._ever_success |= is_success
        return success_alone(is_success, self._ever_success)

    def save(self) -> Any:
        """All of MuJoCo's data, and the plain values of everything that robosuite keeps beside it.

        The whole data, for robosuite goes on from poses that are one physics step old.
        """
        self._running()
        data = copy.copy(self._environment.sim.data._data)
        kept = [copy.deepcopy(_plain(vars(part))) for part in self._parts()]
        rng = copy.deepcopy(self._environment.rng.bit_generator.state)
        memory = copy.deepcopy(self._environment.memory) if self.task.is_bridge else None
        return data, kept, rng, memory, self._steps, self._ever_success, self._last

    def restore(self, content: Any) -> Observation:
        """Returns to a saved state of the same world."""
        data, kept, rng, memory, self._steps, self._ever_success, self._last = content
        if self.task.is_bridge:
            self._environment.memory = copy.deepcopy(memory)
        sim = self._environment.sim
        mujoco.mj_copyData(sim.data._data, sim.model._model, data)
        for part, values in zip(self._parts(), kept, strict=True):
            vars(part).update(copy.deepcopy(values))
        self._environment.rng.bit_generator.state = rng
        assert self._last is not None, "what was saved had been seen"
        return self._last

    def expert_action(self) -> NDArray[np.float64]:
        if not self.task.is_bridge:
            raise InvalidAction(f"task {self.task.name} has no scripted expert")
        self._running()
        action: NDArray[np.float64] = self._environment.expert_action()
        return action

    def close(self) -> None:
        # Else robosuite frees its buffers in whatever context is current: another world's pictures.
        self._make_current()
        self._environment.close()

    def _make_current(self) -> None:
        """robosuite draws into whatever OpenGL context is current, which may be another world's."""
        if self._size != (0, 0):
            self._environment.sim._render_context_offscreen.gl_ctx.make_current()

    def _running(self) -> int:
        if self._steps is None:
            raise InvalidAction("step or save before reset: expected a reset world")
        return self._steps

    def _parts(self) -> list[Any]:
        """Whatever remembers something from one step to the next."""
        parts = [self._environment]
        for robot in self._environment.robots:
            parts += [robot, robot.composite_controller]
            parts += list(robot.part_controllers.values()) + list(robot.gripper.values())
        buffers = [
            buffer for part in parts for value in vars(part).values() for buffer in _buffers(value)
        ]
        observables = list(self._environment._observables.values())
        return parts + buffers + observables

    def _observe(self, observation: Any) -> Observation:
        if self._size == (0, 0):
            image = np.empty((0, 0, 3), np.uint8)
        else:
            # OpenGL's rows start at the bottom.
            image = np.ascontiguousarray(observation[f"{self.task.camera}_image"][::-1])
        if self.task.is_one_arm:
            state = self._state()
        else:
            state = np.concatenate([numbers for _, numbers in _felt(observation)])
        self._last = Observation(image, state.astype(np.float32), self.task.instruction)
        return self._last

    def _state(self) -> NDArray[np.float32]:
        """x y z (m) roll pitch yaw (rad) in the base frame, pad 0, gripper opening 0 to 1."""
        data, model = self._environment.sim.data, self._environment.sim.model
        base = model.body_name2id(self._robot.robot_model.root_body)
        site = model.site_name2id(
            self._robot.gripper[self._robot.arms[0]].important_sites["grip_site"]
        )
        pose = in_base(
            data.body_xpos[base],
            data.body_xmat[base],
            data.site_xpos[site],
            data.site_xmat[site],
            DOWN if self.task.is_bridge else None,
        )
        return np.array([*pose, 0.0, self._opening()], np.float32)

    def _opening(self) -> float:
        """Mean of the gripper's joints, each from its closed end (0) to its open one (1)."""
        model, data = self._environment.sim.model, self._environment.sim.data
        names = self._robot.gripper[self._robot.arms[0]].joints
        shares = []
        for name in names:
            index = model.joint_name2id(name)
            reach = float(np.abs(model.jnt_range[index]).max())
            shares.append(abs(float(data.qpos[model.jnt_qposadr[index]])) / max(reach, 1e-9))
        return min(max(sum(shares) / max(len(shares), 1), 0.0), 1.0)


def _buffers(value: Any) -> list[Any]:
    """robosuite's buffers of recent values, alone or by arm."""
    values = list(value.values()) if isinstance(value, dict) else [value]
    return [one for one in values if type(one).__module__.startswith("robosuite.utils.buffers")]


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    def is_plain(value: Any) -> bool:
        if isinstance(value, (list, tuple)):
            return all(is_plain(element) for element in value)
        if isinstance(value, dict):
            return all(is_plain(element) for element in value.values())
        return isinstance(value, _PLAIN)

    return {name: value for name, value in values.items() if is_plain(value)}
