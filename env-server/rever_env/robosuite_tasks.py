"""robosuite's tasks with any of its robots, and the Bridge tasks in robosuite."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rever_env import opengl, tasks
from rever_env.fault import InvalidReset, RendererUnavailable
from rever_env.protocol import Dimension
from rever_env.robosuite_motion import ARMS_TO_SCALE, is_moved_by_pose
from rever_env.tasks import TaskId

# Instructions, after robosuite's documentation of each task.
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
# Added to a task's version; raised when episodes of the same tasks change. 1: actions move the
# commanded pose, and the arm of the Bridge tasks has no friction.
_REVISION = 1


@dataclass(frozen=True)
class RobosuiteTask:
    """A Bridge task in a variant, or one of robosuite's own tasks, whose variants are robots."""

    name: str
    variant: str
    instruction: str
    steps_max: int
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]
    making: Mapping[str, Any]  # arguments of robosuite.make
    control_hz: float
    camera: str = "agentview"
    version: int = 1 + _REVISION
    layouts: tuple[Any, ...] = ()  # robosuite draws all layouts of its own tasks
    is_bridge: bool = False
    is_one_arm: bool = True


def offered(
    names: Sequence[str], robots: Sequence[str], steps_max: int, control_hz: float
) -> dict[str, RobosuiteTask]:
    """Each named task with each named robot; InvalidReset for an unknown name.

    robots: ROBOT, or ROBOT+ROBOT for a two-armed task. A Bridge task has its own robot, horizon and
    control rate, and its name may include a variant: see tasks.choose. "bridge" means all Bridge
    tasks in all variants.
    """
    robosuite = load_robosuite()
    bridge = tasks.load()
    known_bridge = {task.name for task in bridge.values()}
    ours = [name for name in names if TaskId.parse(name).task in {tasks.BRIDGE, *known_bridge}]
    chosen = tasks.choose(bridge, [tasks.ALL if name == tasks.BRIDGE else name for name in ours])
    own = {str(task.id): bridge_task(task) for task in chosen}
    names = [name for name in names if name not in ours]
    for kind, given, known in (
        ("task", names, {*robosuite.ALL_ENVIRONMENTS, *bridge}),
        ("robot", [one for some in robots for one in some.split("+")], robosuite.ALL_ROBOTS),
    ):
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise InvalidReset(f"{kind}s {unknown}: expected some of {sorted(known)}")
    _check_rate(control_hz, robosuite.macros.SIMULATION_TIMESTEP)
    return own | {
        f"{name}/{robot}": _task(name, robot, steps_max, control_hz)
        for name in names
        for robot in robots
    }


def load_robosuite() -> Any:
    """Imports robosuite so that it uses the software renderer, whatever the variables say."""
    # On import, 1.5.2 reads numbers of EGL devices from the variable.
    hidden = os.environ.pop("CUDA_VISIBLE_DEVICES", None)
    try:
        opengl.choose_device_for_other_libraries()
    except RendererUnavailable:
        pass  # worlds without images need no renderer
    try:
        import robosuite
    finally:
        if hidden is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = hidden
    return robosuite


def _check_rate(control_hz: float, timestep: float) -> None:
    """InvalidReset for a rate that robosuite would change by rounding the physics steps down."""
    steps = 1.0 / (control_hz * timestep) if control_hz > 0.0 else 0.0
    if steps < 0.5 or abs(steps - round(steps)) > 1e-6 * steps:
        raise InvalidReset(
            f"control rate {control_hz:g} Hz: expected a whole number of physics steps of "
            f"{timestep:g} s per control step, got {steps:g}"
        )


def _task(name: str, robot: str, steps_max: int, control_hz: float) -> RobosuiteTask:
    """State and action: those of a Bridge task for one measured arm, otherwise robosuite's own."""
    making = {"env_name": name, "robots": robot.split("+"), "control_freq": control_hz}
    try:
        environment = load_robosuite().make(
            **making, has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False
        )
    except (AssertionError, ValueError) as error:
        raise InvalidReset(f"task {name} with {robot}: {error}") from error
    is_one_arm = (
        robot in ARMS_TO_SCALE
        and environment.action_dim == 7
        and is_moved_by_pose(environment.robots[0])
    )
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
            for part, numbers in felt(environment.reset())
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
        control_hz,
        is_one_arm=is_one_arm,
    )


def felt(observation: Mapping[str, Any]) -> list[tuple[str, NDArray[np.float64]]]:
    """The proprioceptive numbers of each robot."""
    ending = "_proprio-state"
    return [
        (name.removesuffix(ending), np.asarray(observation[name]))
        for name in sorted(observation)
        if name.endswith(ending)
    ]


def bridge_task(task: tasks.Task) -> RobosuiteTask:
    """A Bridge task in robosuite."""
    load_robosuite()
    from rever_env import robosuite_bridge

    return RobosuiteTask(
        task.name,
        task.variant,
        task.instruction,
        task.steps_max,
        task.state,
        task.action,
        {"env_name": robosuite_bridge.ENVIRONMENTS[task.name], "variant": task.variant},
        task.control_hz,
        robosuite_bridge.CAMERA,
        task.version + _REVISION,
        task.layouts,
        is_bridge=True,
    )


def simulator() -> str:
    """The name and version of robosuite."""
    return f"robosuite {metadata.version('robosuite')}"
