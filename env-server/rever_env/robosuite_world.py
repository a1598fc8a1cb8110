"""A robosuite environment as a world of a server."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import opengl
from rever_env.expert import Decision
from rever_env.fault import Fault, InvalidAction, PhysicsDiverged, RendererUnavailable
from rever_env.layout import check_layout
from rever_env.pose import in_base
from rever_env.protocol import Statistics
from rever_env.robosuite_motion import move_commanded_pose
from rever_env.robosuite_tasks import RobosuiteTask, felt, load_robosuite
from rever_env.success import success_alone
from rever_env.world import DOWN, Observation, Transition, broken, silence_warnings

# Values of an object that are saved: numbers, and containers of numbers.
_PLAIN = (np.ndarray, np.generic, float, int, bool, str, type(None))


class RobosuiteWorld:
    """One robosuite environment with its default controller.

    Any thread may use it, one at a time for all such worlds of a process: robosuite draws from
    numpy's global generator. One measured arm takes actions as in a Bridge task, in metres and
    radians in the base frame (see robosuite_motion); the controller limits a move to 50 mm and
    0.5 rad per step, in the Bridge tasks to 100 mm and 0.8 rad. Other robots take robosuite's own
    actions. Statistics of robosuite's own tasks have only success.
    """

    def __init__(self, task: RobosuiteTask, image_height: int, image_width: int) -> None:
        robosuite = load_robosuite()
        silence_warnings()
        self.task = task
        self._size = (image_height, image_width)
        has_image = self._size != (0, 0)
        if has_image and (reason := opengl.unavailable()):
            raise RendererUnavailable(
                f"renderer for {image_height} x {image_width} images: {reason}"
            )
        cameras = (
            {"camera_heights": image_height, "camera_widths": image_width} if has_image else {}
        )
        try:
            with opengl.preserved_context():
                self._environment: Any = robosuite.make(
                    **task.making,
                    has_renderer=False,
                    has_offscreen_renderer=has_image,
                    use_camera_obs=has_image,
                    camera_names=task.camera,
                    ignore_done=True,
                    # Some models are random, such as a cube's size. All worlds have the same one,
                    # because a new model at each reset would take a second.
                    hard_reset=False,
                    seed=0,
                    **cameras,
                )
        except Exception as error:  # robosuite raises errors of many types
            raise Fault(
                f"robosuite cannot create {task.name}: {type(error).__name__}: {error}"
            ) from error
        self._robot = self._environment.robots[0]
        if task.is_one_arm:
            arm = self._robot.part_controllers[self._robot.arms[0]]
            self._scale = np.asarray(arm.output_max, np.float64)
        self._steps: int | None = None
        self._ever_success = False
        self._last: Observation | None = None

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """The same seed gives the same bytes: the state of robosuite's generators is replaced."""
        environment = self._environment
        check_layout(self.task.name, layout, len(self.task.layouts))
        with self._drawing():
            if self.task.is_bridge:
                observation = environment.begin(layout, seed)
            else:
                self._seed(seed)
                observation = environment.reset()
                if self.task.is_one_arm:
                    move_commanded_pose(self._robot)
        self._check_physics(0)
        self._steps, self._ever_success = 0, False
        return self._observe(observation)

    def _seed(self, seed: int) -> None:
        # 1.5.2 ignores the seed of its Gymnasium wrapper. The layout sampler holds the generator
        # object, so that its state must be replaced in place.
        state = np.random.default_rng(seed).bit_generator.state
        self._environment.rng.bit_generator.state = state
        np.random.seed(seed % 2**32)

    def step(self, action: NDArray[np.float64]) -> Transition:
        """Executes one control step. action: float64, as the task describes.

        One measured arm, (7,): dx dy dz (m), rotation vector (rad), gripper (+1 open).
        """
        steps = self._running()
        if steps >= self.task.steps_max:
            raise InvalidAction(
                f"step {steps + 1}: expected at most {self.task.steps_max}; "
                "reset begins a new episode"
            )
        count = len(self.task.action)
        if action.shape != (count,):
            raise InvalidAction(f"action: expected shape ({count},), got {action.shape}")
        if self.task.is_one_arm:
            # robosuite's gripper closes at +1.
            command = np.concatenate([action[:6] / self._scale, [-action[6]]])
            command = np.clip(command, -1.0, 1.0)
        else:
            command = np.clip(action, *self._environment.action_spec)
        with self._drawing():
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
        """Statistics; of robosuite's own tasks only success is known."""
        if self.task.is_bridge:
            statistics: Statistics = self._environment.judged()
            return statistics
        is_success = bool(self._environment._check_success())
        self._ever_success |= is_success
        return success_alone(is_success, self._ever_success)

    def save(self) -> Any:
        """All of MuJoCo's data, and the plain values of all robosuite objects with a memory.

        MuJoCo's state is not enough: robosuite continues from poses that are one physics step old.
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
        assert self._last is not None, "a saved world has been observed"
        return self._last

    def expert_action(self) -> NDArray[np.float64]:
        return self.expert_decision().action

    def expert_decision(self) -> Decision:
        """The scripted expert's action with its subtask; only Bridge tasks have an expert."""
        if not self.task.is_bridge:
            raise InvalidAction(f"task {self.task.name} has no scripted expert")
        self._running()
        decision: Decision = self._environment.expert_decision()
        return decision

    def close(self) -> None:
        # Otherwise robosuite would free buffers of another current OpenGL context.
        with self._drawing():
            self._environment.close()

    @contextmanager
    def _drawing(self) -> Iterator[None]:
        """Makes this world's OpenGL context current inside the block, as robosuite assumes."""
        with opengl.preserved_context():
            if self._size != (0, 0):
                self._environment.sim._render_context_offscreen.gl_ctx.make_current()
            yield

    def _running(self) -> int:
        if self._steps is None:
            raise InvalidAction("step or save before reset: call reset first")
        return self._steps

    def _parts(self) -> list[Any]:
        """The robosuite objects with a memory."""
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
            state = np.concatenate([numbers for _, numbers in felt(observation)])
        self._last = Observation(image, state.astype(np.float32), self.task.instruction)
        return self._last

    def _state(self) -> NDArray[np.float32]:
        """x y z (m) roll pitch yaw (rad) in the base frame, 0, gripper opening 0 to 1."""
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
        """The mean opening of the gripper's joints, 0 (closed) to 1 (open)."""
        model, data = self._environment.sim.model, self._environment.sim.data
        names = self._robot.gripper[self._robot.arms[0]].joints
        shares = []
        for name in names:
            index = model.joint_name2id(name)
            reach = float(np.abs(model.jnt_range[index]).max())
            shares.append(abs(float(data.qpos[model.jnt_qposadr[index]])) / max(reach, 1e-9))
        return min(max(sum(shares) / max(len(shares), 1), 0.0), 1.0)


def _buffers(value: Any) -> list[Any]:
    """robosuite's buffers of recent values, single or by arm."""
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
