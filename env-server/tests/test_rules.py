"""The rules of the published setup: start pose, control, camera, success thresholds."""

import math

import mujoco
import numpy as np
import pytest

from rever_env.tasks import Task
from rever_env.world import World

# Tool centre point in the base frame at the start, metres (facts of the published URDF and qpos).
_START = {
    "table": (0.29207, -0.00609, 0.13532),
    "sink": (0.24972, -0.06751, 0.22759),
}
# Largest horizontal distance and height of the source's centre over the target's, metres.
_THRESHOLDS = {
    "widowx_spoon_on_towel": (0.0737, 0.0380),
    "widowx_carrot_on_plate": (0.0808, 0.0420),
    "widowx_carrot_on_plate/size-0.5": (0.0808, 0.0325),
    "widowx_stack_cube": (0.0242, 0.0500),
    "widowx_put_eggplant_in_basket": (0.0793, 0.0800),
}


def test_the_arm_starts_where_the_published_one_does(world: World, task: Task) -> None:
    state = world.reset(layout=0, seed=0).state
    scene = "sink" if "eggplant" in task.name else "table"
    assert state[:3] == pytest.approx(_START[scene], abs=2e-4)
    assert state[6:] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert np.abs(state[3:5]).max() < 0.1, "the gripper points down"


def test_success_thresholds_equal_the_published_ones(world: World, task: Task) -> None:
    world.reset(layout=0, seed=0)
    memory = world.running_memory()
    horizontal = math.hypot(*memory.target_half[:2]) + task.grasp.target_margin
    vertical = memory.target_half[2] + memory.source_half[2] + task.height_offset_max
    expected = _THRESHOLDS.get(str(task.id), _THRESHOLDS[task.name])
    assert (horizontal, vertical) == pytest.approx(expected, abs=2e-4)


def test_objects_rest_after_reset(world: World, task: Task) -> None:
    for index in (0, 13, 23):
        world.reset(layout=index, seed=0)
        layout = task.layouts[index]
        source = world.data.body(task.source)
        assert source.xpos[:2] == pytest.approx([layout.source_x, layout.source_y], abs=3e-3)
        before = source.xpos.copy()
        for _ in range(3):
            world.step(np.array([0.0] * 6 + [1.0]))
        assert np.abs(world.data.body(task.source).xpos - before).max() < 5e-4


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_translation_moves_the_tool_in_the_base_frame(cube_world: World, axis: int) -> None:
    start = cube_world.reset(layout=0, seed=0).state[:3].astype(float)
    action = np.array([0.0] * 6 + [1.0])
    action[axis] = 0.02
    cube_world.step(action)
    stay = np.array([0.0] * 6 + [1.0])
    for _ in range(12):
        state = cube_world.step(stay).observation.state
    moved = state[:3] - start
    expected = np.zeros(3)
    expected[axis] = 0.02
    assert moved == pytest.approx(expected, abs=1.5e-3)


def test_a_turn_is_about_the_tool_and_the_base_axes(cube_world: World) -> None:
    start = cube_world.reset(layout=0, seed=0).state
    for _ in range(2):
        cube_world.step(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 1.0]))
    for _ in range(12):
        state = cube_world.step(np.array([0.0] * 6 + [1.0])).observation.state
    assert state[:3] == pytest.approx(start[:3], abs=2e-3)
    assert float(state[5] - start[5]) == pytest.approx(0.4, abs=0.02)


def test_an_unreachable_target_keeps_the_arm_where_it_is(cube_world: World) -> None:
    start = cube_world.reset(layout=0, seed=0).state
    state = cube_world.step(np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])).observation.state
    assert state[:3] == pytest.approx(start[:3], abs=5e-3)


def test_the_field_of_view_is_the_published_one(cube_world: World) -> None:
    index = cube_world.model.camera("third_person").id
    focal, sensor = (
        cube_world.model.cam_intrinsic[index][:2],
        cube_world.model.cam_sensorsize[index],
    )
    degrees = np.degrees(2.0 * np.arctan(sensor / (2.0 * focal)))
    assert degrees == pytest.approx([54.33, 42.10], abs=0.01)


def test_any_image_shape_shows_the_same_field_of_view(task: Task) -> None:
    means = []
    for height, width in ((480, 640), (128, 128)):
        with World(task, height, width) as shaped:
            image = shaped.reset(layout=0, seed=0).image
            assert image.shape == (height, width, 3)
            # (height, width, 3) -> (16, 16, 3): mean colours of a coarse grid
            blocks = image.reshape(16, height // 16, 16, width // 16, 3).mean(axis=(1, 3))
            means.append(blocks)
    assert np.abs(means[0] - means[1]).mean() < 2.0


def test_projection_agrees_with_the_image(world: World, task: Task) -> None:
    world.reset(layout=0, seed=0)
    seen = world.camera.bodies(world.data) == world.model.body(task.source).id
    x, y = world.camera.project(world.data, world.data.body(task.source).xipos)
    assert seen[int(y * 128), int(x * 128)]


def test_a_finger_touching_nothing_is_no_grasp(cube_world: World) -> None:
    cube_world.reset(layout=0, seed=0)
    for _ in range(4):
        statistics = cube_world.step(np.array([0.0] * 6 + [-1.0])).statistics
    assert not statistics.is_grasped and not statistics.ever_grasped


def test_a_held_object_over_the_target_is_success_but_not_released(world: World) -> None:
    world.reset(layout=0, seed=0)
    held_successes = 0
    while world.steps < world.task.steps_max:
        statistics = world.step(world.expert_action()).statistics
        held_successes += statistics.is_success and statistics.is_grasped
        assert not (statistics.released_success and statistics.is_grasped)
        assert statistics.is_success == statistics.source_on_target
    assert held_successes > 0
    assert statistics.released_success and statistics.is_success and statistics.ever_success
    assert statistics.consecutive_grasp and statistics.moved_correct_object
    assert not statistics.moved_wrong_object


def test_pushing_the_target_counts_as_the_wrong_object(task: Task) -> None:
    if task.target_height is None:
        pytest.skip("the basket cannot be moved")
    with World(task) as pushed:
        pushed.reset(layout=0, seed=0)
        joint = pushed.model.joint(task.target)
        pushed.data.qpos[joint.qposadr[0]] += 0.04
        mujoco.mj_forward(pushed.model, pushed.data)
        statistics = pushed.step(np.array([0.0] * 6 + [1.0])).statistics
        assert statistics.moved_wrong_object and not statistics.moved_correct_object
