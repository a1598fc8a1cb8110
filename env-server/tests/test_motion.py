"""Commanded moves in metres and radians are the measured moves, in every simulator."""

from typing import Any

import numpy as np
import pytest
from conftest import TASKS
from numpy.typing import NDArray

from rever_env.fault import InvalidReset
from rever_env.robosuite_motion import ARMS_TO_SCALE, BRIDGE_MOVE_TOLERANCE, MOVE_TOLERANCE
from rever_env.world import World
from rever_env.worlds import AnyWorld

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
STEPS = 5
STEP_SIZES = np.array([0.01] * 3 + [0.1] * 3)  # metres, rad
REST_SECS = 2.0
ARM_JOINTS = TASKS["widowx_stack_cube"].settings.arm_joints
Vector = NDArray[np.float64]


def rotation(state: NDArray[np.float32]) -> Vector:
    """The gripper's attitude in the base's frame, (3, 3), from roll, pitch and yaw."""
    roll, pitch, yaw = state[3:6].astype(np.float64)
    matrix = np.eye(3)
    for angle, first, second in ((roll, 1, 2), (pitch, 2, 0), (yaw, 0, 1)):
        turn = np.eye(3)
        turn[first, first] = turn[second, second] = np.cos(angle)
        turn[second, first], turn[first, second] = np.sin(angle), -np.sin(angle)
        matrix = turn @ matrix
    return matrix


def moved(world: AnyWorld, axis: int, sign: float, control_hz: float) -> Vector:
    """How far the gripper has gone when it rests: metres (3) and rotation vector in rad (3)."""
    hold = np.array([0.0] * 6 + [1.0])
    action = hold.copy()
    action[axis] = sign * STEP_SIZES[axis]
    before = world.reset(layout=None, seed=1).state
    for command in [action] * STEPS + [hold] * round(REST_SECS * control_hz):
        after = world.step(command).observation.state
    turn = rotation(after) @ rotation(before).T
    angle = np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))
    axial = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    length = np.linalg.norm(axial)
    return np.concatenate(
        [after[:3] - before[:3], axial / length * angle if length > 0.0 else axial]
    )


def check_moves(
    world: AnyWorld, tolerance: float, control_hz: float, *, signs: tuple[float, ...] = (1.0, -1.0)
) -> None:
    for axis, name in enumerate(AXES):
        for sign in signs:
            share = moved(world, axis, sign, control_hz) / (STEPS * STEP_SIZES)
            assert share[axis] == pytest.approx(sign, abs=tolerance), f"{name} {sign}: {share}"


@pytest.mark.parametrize("name", sorted(TASKS))
def test_a_bridge_move_is_as_long_as_commanded(name: str) -> None:
    with World(TASKS[name], 0, 0) as world:
        check_moves(world, BRIDGE_MOVE_TOLERANCE, 5.0)


@pytest.mark.parametrize("name", ["widowx_stack_cube", "widowx_put_eggplant_in_basket"])
def test_a_bridge_move_in_robosuite_is_as_long_as_commanded(name: str) -> None:
    world = robosuite_world(name, "", 5.0)
    check_moves(world, BRIDGE_MOVE_TOLERANCE, world.task.control_hz)
    world.close()


@pytest.mark.parametrize("robot", ARMS_TO_SCALE)
def test_a_move_of_one_of_robosuites_arms_is_as_long_as_commanded(robot: str) -> None:
    world = robosuite_world("Lift", robot, 20.0)
    assert world.task.is_one_arm
    check_moves(world, MOVE_TOLERANCE, 20.0, signs=(1.0,))
    world.close()


def test_an_arm_that_is_not_to_scale_takes_robosuites_own_actions() -> None:
    world = robosuite_world("Lift", "IIWA", 20.0)
    names = [dimension.name for dimension in world.task.action]
    assert names == [f"action[{index}]" for index in range(7)]
    assert len(world.reset(layout=None, seed=0).state) == len(world.task.state) != 8
    world.close()


def test_the_controller_is_the_one_that_was_asked_for() -> None:
    world = robosuite_world("widowx_stack_cube", "", 20.0)
    world.reset(layout=0, seed=0)
    (robot,) = world._environment.robots
    controller = robot.part_controllers["right"]
    assert (controller.name, controller.input_type) == ("OSC_POSE", "delta")
    assert (controller.input_ref_frame, controller._goal_update_mode) == ("base", "desired")
    assert controller.interpolator_pos is None and controller.interpolator_ori is None
    np.testing.assert_array_equal(controller.kp, [600.0] * 6)
    np.testing.assert_allclose(controller.kd, [2.0 * 600.0**0.5] * 6)
    np.testing.assert_array_equal(controller.output_max, [0.1] * 3 + [0.8] * 3)
    np.testing.assert_array_equal(controller.output_min, [-0.1] * 3 + [-0.8] * 3)
    model = world._environment.sim.model._model
    dofs = [model.joint(f"robot0_{name}").dofadr[0] for name in ARM_JOINTS]
    assert not model.dof_damping[dofs].any() and not model.dof_frictionloss[dofs].any()
    before = world._environment.sim.data.time
    world.step(np.array([0.0] * 6 + [1.0]))
    passed = world._environment.sim.data.time - before
    assert passed == pytest.approx(1.0 / world.task.control_hz)
    world.close()


@pytest.mark.parametrize("control_hz", [20.0, 12.5, 500.0])
def test_a_control_step_lasts_as_long_as_its_rate_says(control_hz: float) -> None:
    world = robosuite_world("Lift", "Panda", control_hz)
    world.reset(layout=None, seed=0)
    before = world._environment.sim.data.time
    world.step(np.array([0.0] * 6 + [1.0]))
    passed = world._environment.sim.data.time - before
    assert passed == pytest.approx(1.0 / control_hz)
    world.close()


@pytest.mark.parametrize("control_hz", [30.0, 0.0, -5.0, 1000.0])
def test_a_rate_that_robosuite_would_round_is_refused(control_hz: float) -> None:
    with pytest.raises(InvalidReset, match=f"control rate {control_hz:g} Hz: expected a whole"):
        robosuite_world("Lift", "Panda", control_hz)


def robosuite_world(task: str, robot: str, control_hz: float) -> Any:
    """A world without images in robosuite; robot: empty for a Bridge task."""
    pytest.importorskip("robosuite")
    from rever_env.robosuite_tasks import offered
    from rever_env.robosuite_world import RobosuiteWorld

    offers = offered([task], [robot] if robot else [], 500, control_hz)
    return RobosuiteWorld(next(iter(offers.values())), 0, 0)
