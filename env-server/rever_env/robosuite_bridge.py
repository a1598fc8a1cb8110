"""The Bridge tasks as robosuite environments, with robosuite's controllers and our WidowX."""

import copy
from dataclasses import dataclass, replace
from types import new_class
from typing import Any

import mujoco
import numpy as np
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.tasks import ManipulationTask

from rever_env import expert, tasks
from rever_env.layout import SEED_LIMIT, place
from rever_env.protocol import Statistics
from rever_env.robosuite_models import WidowX, bridge_arena, fit_scene
from rever_env.robosuite_motion import is_moved_by_pose, move_commanded_pose
from rever_env.success import Judge, Memory
from rever_env.tasks import Layout, Task
from rever_env.world import place_objects

CAMERA = "robot0_third_person"
# robosuite's prefixes of the parts that a task's rules name.
_ROBOT_PREFIX, _GRIPPER_PREFIX = "robot0_", "gripper0_right_"
# The largest move of a control step in metres and radians, above the bounds of the action space.
_MOVE_MAX, _TURN_MAX = 0.1, 0.8
_CONTROLLER = {
    "type": "BASIC",
    "body_parts": {
        "right": {
            "type": "OSC_POSE",
            "input_type": "delta",
            "input_ref_frame": "base",
            "output_max": [_MOVE_MAX] * 3 + [_TURN_MAX] * 3,
            "output_min": [-_MOVE_MAX] * 3 + [-_TURN_MAX] * 3,
            "kp": 600,
            "damping_ratio": 1,
            "interpolation": None,
            "gripper": {"type": "GRIP"},
        }
    },
}


@dataclass(frozen=True)
class _Stage:
    """A running episode as the input of the expert."""

    model: mujoco.MjModel
    data: mujoco.MjData
    task: Task
    judge: Judge
    memory: Memory

    def running_memory(self) -> Memory:
        return self.memory


class BridgeTask(ManipulationEnv):  # type: ignore[misc]
    """One Bridge task in one of its variants.

    begin(layout, seed) resets to a reproducible layout; reset() draws one from robosuite's own
    generator. reward: 1 if the task is solved, else 0.
    """

    task_name = ""

    def __init__(
        self,
        robots: Any = WidowX.__name__,
        controller_configs: Any = None,
        variant: str = tasks.DEFAULT,
        **arguments: Any,
    ):
        self.task = _renamed(tasks.find(tasks.load(), self.task_name, variant))
        self._placement: Layout | None = None
        self.memory: Memory | None = None
        arguments.setdefault("control_freq", self.task.control_hz)
        arguments.setdefault("camera_names", CAMERA)
        arguments.setdefault("render_camera", CAMERA)
        arguments.setdefault("initialization_noise", None)
        arguments.setdefault("horizon", self.task.steps_max)
        controller = copy.deepcopy(_CONTROLLER)
        super().__init__(
            robots=robots, controller_configs=controller_configs or controller, **arguments
        )

    def begin(self, layout: int | None, seed: int) -> Any:
        """Begins an episode and returns its observation; equal arguments give equal episodes."""
        self._placement = place(self.task, layout, seed)
        try:
            return self.reset()
        finally:
            self._placement = None

    def reward(self, action: Any = None) -> float:
        return float(self._check_success())

    def judged(self) -> Statistics:
        """The episode statistics. Call it exactly once per control step: it updates a memory."""
        assert self.memory is not None, "an episode has begun"
        return self.judge.judge(self._data(), self.memory)

    def expert_decision(self) -> expert.Decision:
        """The scripted expert's action, float64 (7,) as in World, with its subtask."""
        assert self.memory is not None, "an episode has begun"
        stage = _Stage(self.sim.model._model, self._data(), self.task, self.judge, self.memory)
        return expert.decide(self.task, expert.look(stage))

    def _data(self) -> mujoco.MjData:
        """MuJoCo's data, for the rules of the task."""
        return self.sim.data._data

    def _check_success(self) -> bool:
        assert self.memory is not None, "an episode has begun"
        data = self._data()
        return self.judge.on_target(data, self.memory, self.judge.touch(data))

    def _load_model(self) -> None:
        super()._load_model()
        (robot,) = self.robots
        robot.init_qpos = np.array(self.task.robot_joints[:6])
        self.model = ManipulationTask(
            mujoco_arena=bridge_arena(self.task),
            mujoco_robots=[robot.robot_model],
            mujoco_objects=[],
        )
        fit_scene(self.model.root, robot.robot_model, self.task)
        # Explicit Euler diverges with the damping of the fingers' drives.
        self.model.root.find("option").set("integrator", "implicitfast")

    def _setup_references(self) -> None:
        super()._setup_references()
        self.judge = Judge(self.sim.model._model, self.task)

    def _reset_internal(self) -> None:
        super()._reset_internal()
        layout = self._placement
        if layout is None:
            layout = place(self.task, None, int(self.rng.integers(SEED_LIMIT)))
        model, data = self.sim.model._model, self._data()
        place_objects(model, data, self.task, layout)
        self._settle(model, data)
        self.memory = self.judge.begin(data)
        (robot,) = self.robots
        if is_moved_by_pose(robot):
            move_commanded_pose(robot)

    def _settle(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Lets the objects come to rest while the robot, not controlled yet, is held."""
        settings = self.task.settings
        joints = [model.joint(name) for name in settings.arm_joints + settings.finger_joints]
        positions = [joint.qposadr[0] for joint in joints]
        speeds = [joint.dofadr[0] for joint in joints]
        data.qpos[positions] = self.task.robot_joints
        for _ in range(2):
            for _ in range(round(settings.settle / settings.timestep)):
                mujoco.mj_step(model, data)
                data.qpos[positions] = self.task.robot_joints
                data.qvel[speeds] = 0.0
            data.qvel[:] = 0.0
        self.sim.forward()


def _environment(task: Task) -> str:
    """Defines the task's class, which registers it with robosuite; returns its name."""
    name = task.gymnasium_id.removeprefix("rever/").partition("-")[0]
    body = {"task_name": task.name, "__doc__": task.instruction}
    new_class(name, (BridgeTask,), exec_body=lambda namespace: namespace.update(body))
    return name


ENVIRONMENTS = {task.name: _environment(task) for task in tasks.choose(tasks.load(), None)}


def _renamed(task: Task) -> Task:
    """The task with robosuite's names of bodies, joints, sites and the camera."""
    settings = task.settings

    def of_gripper(names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(_GRIPPER_PREFIX + name for name in names)

    names = replace(
        settings,
        tcp=f"{_GRIPPER_PREFIX}grip_site",
        camera=CAMERA,
        arm_joints=tuple(_ROBOT_PREFIX + name for name in settings.arm_joints),
        finger_joints=of_gripper(settings.finger_joints),
        finger_bodies=of_gripper(settings.finger_bodies),
        robot_body=_ROBOT_PREFIX + settings.robot_body,
    )
    return replace(task, settings=names)
