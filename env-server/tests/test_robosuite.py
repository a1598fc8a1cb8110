"""robosuite's environments behind the protocol, where robosuite is installed."""

import gc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rever_env import tasks
from rever_env.fault import InvalidAction, InvalidReset, PhysicsDiverged
from rever_env.world import Observation, World

pytest.importorskip("robosuite")

from rever_env.robosuite_tasks import offered
from rever_env.robosuite_world import RobosuiteWorld

MOVE = np.array([0.01, 0.005, -0.01, 0.0, 0.0, 0.05, -1.0])


@pytest.fixture(scope="module")
def worlds() -> Iterator[list[RobosuiteWorld]]:
    """Two of one kind and one of another, in the same thread."""
    offers = offered(["Lift", "Stack"], ["Panda"], 6, 20.0)
    worlds = [
        RobosuiteWorld(offers["Lift/Panda"], 24, 40),
        RobosuiteWorld(offers["Lift/Panda"], 24, 40),
        RobosuiteWorld(offers["Stack/Panda"], 32, 32),
    ]
    yield worlds
    for world in worlds:
        world.close()


def run(world: RobosuiteWorld, seed: int) -> list[Observation]:
    observations = [world.reset(layout=None, seed=seed)]
    return observations + [world.step(MOVE).observation for _ in range(5)]


def same(one: Observation, other: Observation) -> bool:
    return np.array_equal(one.image, other.image) and np.array_equal(one.state, other.state)


def test_the_same_seed_gives_the_same_bytes_in_any_world(worlds: list[RobosuiteWorld]) -> None:
    first, second, other = worlds
    expected = run(first, 7)
    run(first, 8)
    run(other, 7)
    for again in (run(first, 7), run(second, 7)):
        assert all(same(*pair) for pair in zip(expected, again, strict=True))
    assert not same(run(first, 8)[0], expected[0])
    assert expected[0].image.shape == (24, 40, 3)


def test_save_and_restore_are_bit_exact(worlds: list[RobosuiteWorld]) -> None:
    world, _, other = worlds
    world.reset(layout=None, seed=3)
    saved_at = world.step(MOVE).observation
    saved = world.save()
    expected = [world.step(MOVE).observation for _ in range(4)]
    run(other, 1)
    assert same(world.restore(saved), saved_at)
    again = [world.step(MOVE).observation for _ in range(4)]
    assert all(same(*pair) for pair in zip(expected, again, strict=True))


def test_the_bridge_tasks_are_offered_in_the_variants_that_are_named() -> None:
    assert list(offered(["bridge"], [], 6, 20.0)) == list(tasks.load())
    some = offered(["widowx_stack_cube", "widowx_carrot_on_plate/all"], [], 6, 20.0)
    carrots = ["widowx_carrot_on_plate", "widowx_carrot_on_plate/size-0.5"]
    assert list(some) == [*carrots, "widowx_stack_cube"]
    assert {task.variant for task in some.values()} == {"default", "size-0.5"}
    with pytest.raises(InvalidReset, match="task widowx_stack_cube/x: expected one of widowx_"):
        offered(["widowx_stack_cube/x"], [], 6, 20.0)


def test_a_change_of_the_robot_is_refused_in_robosuite() -> None:
    from rever_env.robosuite_models import bridge_arena

    task = tasks.load()["widowx_stack_cube"]
    camera = tasks.MjcfChange("camera", "third_person", "focal", "0.5 0.5")
    bridge_arena(replace(task, mjcf=(camera,)))
    finger = tasks.MjcfChange("geom", "left_finger_pad", "friction", "2 0.01 0.0001")
    with pytest.raises(InvalidReset, match="changes its geom left_finger_pad"):
        bridge_arena(replace(task, mjcf=(camera, finger)))


def test_what_is_wrong_is_said(worlds: list[RobosuiteWorld]) -> None:
    world = worlds[0]
    with pytest.raises(InvalidReset, match="Fold"):
        offered(["Fold"], ["Panda"], 6, 20.0)
    with pytest.raises(InvalidReset, match="TwoArmLift with Panda"):
        offered(["TwoArmLift"], ["Panda"], 6, 20.0)
    with pytest.raises(InvalidReset, match="layout 0"):
        world.reset(layout=0, seed=0)
    run(world, 0)
    world.step(MOVE)
    for _ in range(2):
        with pytest.raises(InvalidAction, match="step 7: expected at most 6"):
            world.step(MOVE)
        # What is refused changes nothing: the episode is still at its end.
        with pytest.raises(InvalidReset, match="layout 0"):
            world.reset(layout=0, seed=0)


def test_physics_that_started_anew_is_a_fault(worlds: list[RobosuiteWorld]) -> None:
    """MuJoCo resets what has diverged by itself: nothing that robosuite gives tells."""
    world = worlds[0]
    expected = run(world, 2)
    world.reset(layout=None, seed=2)
    world.step(MOVE)
    world._environment.sim.data._data.qvel[0] = 1e12
    with pytest.raises(PhysicsDiverged, match="mjWARN_BADQVEL"):
        world.step(MOVE)
    with pytest.raises(InvalidAction, match="before reset"):
        world.step(MOVE)
    assert all(same(*pair) for pair in zip(expected, run(world, 2), strict=True))


def test_a_world_that_is_closed_takes_no_other_worlds_pictures(
    worlds: list[RobosuiteWorld],
) -> None:
    first = worlds[0]
    expected = run(first, 4)
    other = RobosuiteWorld(offered(["Stack"], ["Panda"], 6, 20.0)["Stack/Panda"], 24, 40)
    other.reset(layout=None, seed=0)
    first.reset(layout=None, seed=4)
    other.close()
    del other
    gc.collect()
    assert all(same(*pair) for pair in zip(expected, run(first, 4), strict=True))


def test_another_thread_gets_the_same_images(worlds: list[RobosuiteWorld]) -> None:
    expected = run(worlds[0], 5)
    with ThreadPoolExecutor(1) as thread:
        for world in worlds[:2]:
            again = thread.submit(run, world, 5).result(timeout=120)
            assert all(same(*pair) for pair in zip(expected, again, strict=True))
    assert all(same(*pair) for pair in zip(expected, run(worlds[0], 5), strict=True))


def test_two_arms_take_robosuites_own_actions() -> None:
    world = RobosuiteWorld(
        offered(["TwoArmLift"], ["Panda+UR5e"], 6, 20.0)["TwoArmLift/Panda+UR5e"], 24, 40
    )
    move = np.linspace(-0.5, 0.5, len(world.task.action))
    assert len(move) == 14

    def steps(count: int) -> list[Observation]:
        return [world.step(move).observation for _ in range(count)]

    expected = [world.reset(layout=None, seed=2), *steps(2)]
    assert len(expected[0].state) == len(world.task.state)
    saved = world.save()
    after = steps(3)
    again = [world.reset(layout=None, seed=2), *steps(2)]
    assert all(same(*pair) for pair in zip(expected, again, strict=True))
    world.reset(layout=None, seed=3)
    world.restore(saved)
    assert all(same(*pair) for pair in zip(after, steps(3), strict=True))
    with pytest.raises(InvalidAction, match=r"expected shape \(14,\)"):
        world.step(MOVE)
    world.close()


@pytest.fixture(scope="module")
def bridge() -> Iterator[RobosuiteWorld]:
    """A Bridge task with robosuite's controller."""
    world = RobosuiteWorld(offered(["widowx_stack_cube"], [], 6, 20.0)["widowx_stack_cube"], 24, 40)
    yield world
    world.close()


@pytest.mark.parametrize("task", list(tasks.load()))
def test_a_bridge_task_starts_as_ours_does(task: str) -> None:
    bridge = RobosuiteWorld(offered([task], [], 6, 20.0)[task], 96, 128)
    seen = bridge.reset(layout=5, seed=0)
    bridge.close()
    with World(tasks.load()[task], 96, 128) as ours:
        expected = ours.reset(layout=5, seed=0)
    assert np.abs(seen.state - expected.state).max() < 1e-3
    assert seen.instruction == expected.instruction
    # Objects settle a little differently under robosuite's solver; nothing else may differ.
    difference = seen.image.astype(float) - expected.image.astype(float)
    assert np.abs(difference).mean() < 0.1


def test_bridge_tasks_are_reproducible_and_saved_exactly(bridge: RobosuiteWorld) -> None:
    expected = run(bridge, 7)
    run(bridge, 8)
    again = run(bridge, 7)
    assert all(same(*pair) for pair in zip(expected, again, strict=True))
    saved, goal = bridge.save(), commanded(bridge)
    after = [bridge.step(MOVE) for _ in range(3)]
    bridge.reset(layout=0, seed=0)
    assert not np.array_equal(commanded(bridge), goal)
    bridge.restore(saved)
    np.testing.assert_array_equal(commanded(bridge), goal)
    for transition in after:
        repeated = bridge.step(MOVE)
        assert same(repeated.observation, transition.observation)
        assert repeated.statistics == transition.statistics


def commanded(world: RobosuiteWorld) -> NDArray[np.float64]:
    """The commanded position in the base's frame, (3,)."""
    controller = world._environment.robots[0].part_controllers["right"]
    position: NDArray[np.float64] = np.array(controller.goal_pos)
    return position


def test_a_task_has_another_version_where_its_episodes_differ() -> None:
    ours = tasks.load()["widowx_stack_cube"]
    offers = offered([ours.name, "Lift"], ["Panda"], 6, 20.0)
    assert offers[ours.name].version > ours.version
    assert offers["Lift/Panda"].version > 1


@pytest.mark.parametrize("task", list(tasks.load()))
def test_the_expert_solves_the_bridge_tasks_in_robosuite(task: str) -> None:
    world = RobosuiteWorld(offered([task], [], 6, 20.0)[task], 0, 0)
    world.reset(layout=None, seed=2_000_000_000)
    transition = world.step(world.expert_action())
    while not transition.truncated:
        transition = world.step(world.expert_action())
    world.close()
    assert transition.statistics.ever_grasped and transition.statistics.is_success
    assert transition.reward == 1.0
