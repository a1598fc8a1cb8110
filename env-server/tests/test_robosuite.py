"""robosuite's environments behind the protocol, where robosuite is installed."""

from collections.abc import Iterator

import numpy as np
import pytest

from rever_env.fault import InvalidAction, InvalidPlacement
from rever_env.world import Observation

pytest.importorskip("robosuite")

from rever_env.robosuite_world import RobosuiteWorld, offered

MOVE = np.array([0.01, 0.005, -0.01, 0.0, 0.0, 0.05, -1.0])


@pytest.fixture(scope="module")
def worlds() -> Iterator[list[RobosuiteWorld]]:
    """Two of one kind and one of another, in the same thread."""
    tasks = offered(["Lift", "Stack"], ["Panda"], 6, 20.0)
    worlds = [
        RobosuiteWorld(tasks["Lift/Panda"], 24, 40),
        RobosuiteWorld(tasks["Lift/Panda"], 24, 40),
        RobosuiteWorld(tasks["Stack/Panda"], 32, 32),
    ]
    yield worlds
    for world in worlds:
        world.close()


def run(world: RobosuiteWorld, seed: int) -> list[Observation]:
    observations = [world.reset(configuration=None, seed=seed)]
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
    world.reset(configuration=None, seed=3)
    saved_at = world.step(MOVE).observation
    saved = world.save()
    expected = [world.step(MOVE).observation for _ in range(4)]
    run(other, 1)
    assert same(world.restore(saved), saved_at)
    again = [world.step(MOVE).observation for _ in range(4)]
    assert all(same(*pair) for pair in zip(expected, again, strict=True))


def test_an_action_moves_the_gripper_as_far_as_it_says(worlds: list[RobosuiteWorld]) -> None:
    world = worlds[0]
    before = world.reset(configuration=None, seed=1).state
    for _ in range(5):
        after = world.step(np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 1.0])).observation.state
    assert 0.02 < after[2] - before[2] < 0.1
    assert abs(after[0] - before[0]) < 0.01 and abs(after[1] - before[1]) < 0.01
    assert after[7] > before[7]


def test_what_is_wrong_is_said(worlds: list[RobosuiteWorld]) -> None:
    world = worlds[0]
    with pytest.raises(InvalidPlacement, match="Fold"):
        offered(["Fold"], ["Panda"], 6, 20.0)
    with pytest.raises(InvalidPlacement, match="expected one arm"):
        RobosuiteWorld(offered(["Lift"], ["Baxter"], 6, 20.0)["Lift/Baxter"], 0, 0)
    with pytest.raises(InvalidPlacement, match="configuration 0"):
        world.reset(configuration=0, seed=0)
    run(world, 0)
    world.step(MOVE)
    with pytest.raises(InvalidAction, match="step 7: expected at most 6"):
        world.step(MOVE)
