"""Gymnasium's environments behind the protocol, where their packages are installed."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env.fault import InvalidAction, InvalidReset, PhysicsDiverged
from rever_env.gymnasium_tasks import Making, imported, offered
from rever_env.gymnasium_world import GymnasiumWorld, NotReproducible
from rever_env.protocol import Dimension
from rever_env.server import Server, ServerOptions
from rever_env.space_parts import dimensions_of, numbers_of, value_of
from rever_env.world import Observation
from rever_env.worlds import Worlds

pytest.importorskip("gymnasium_robotics")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame needs no screen

NESTED = spaces.Dict(
    {
        "arm": spaces.Box(np.array([-1.0, -np.inf]), np.array([1.0, np.inf])),
        "buttons": spaces.MultiBinary(2),
        "camera": spaces.Box(0, 255, (4, 6, 3), np.uint8),
        "mode": spaces.Tuple((spaces.Discrete(3, start=1), spaces.MultiDiscrete([2, 5]))),
        "task": spaces.Text(10),
    }
)


class Fickle(gymnasium.Env[NDArray[np.float32], Any]):
    """Counts its resets, and shows the count: not reproducible. Action 1 breaks it."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space: spaces.Space[Any] = spaces.Discrete(2)
    resets = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        Fickle.resets += 1
        return np.array([Fickle.resets], np.float32), {}

    def step(self, action: int) -> Any:
        seen = np.array([np.nan if action else Fickle.resets], np.float32)
        return seen, 1.0, False, False, {}


class Redrawn(gymnasium.Env[NDArray[np.uint8], Any]):
    """Draws each step into the same array."""

    observation_space = spaces.Box(0, 255, (16, 32, 3), np.uint8)
    action_space: spaces.Space[Any] = spaces.Discrete(2)

    def __init__(self) -> None:
        self.picture = np.zeros((16, 32, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.picture[:] = 0
        return self.picture, {}

    def step(self, action: int) -> Any:
        self.picture[:] += 1
        return self.picture, 1.0, False, False, {}


class Wide(Fickle):
    """Has more numbers than fit into a Step."""

    action_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (200,))


class Sealed(Fickle):
    """Cannot be made or closed while it is broken."""

    is_broken = False

    def __init__(self) -> None:
        if Sealed.is_broken:
            raise OSError("no assets")

    def close(self) -> None:
        if Sealed.is_broken:
            raise RuntimeError("stuck")


def make(name: str, height: int, width: int, *imports: str) -> GymnasiumWorld:
    return GymnasiumWorld(offered([name], imports, Making(), 50)[name], height, width)


def actions(world: GymnasiumWorld, count: int) -> list[NDArray[np.float64]]:
    """Within the bounds, never twice the same where there is a choice."""
    random = np.random.default_rng(1)

    def number(dimension: Dimension) -> float:
        low = -1.0 if dimension.low is None else dimension.low
        high = 1.0 if dimension.high is None else dimension.high
        if dimension.discrete:
            return float(random.integers(int(low), int(high) + 1))
        return float(random.uniform(low, high))

    return [np.array([number(one) for one in world.task.action]) for _ in range(count)]


def same(one: Observation, other: Observation) -> bool:
    return np.array_equal(one.image, other.image) and np.array_equal(one.state, other.state)


@pytest.fixture(
    scope="module",
    params=[
        ("CartPole-v1",),
        ("MountainCarContinuous-v0",),
        ("Taxi-v4",),
        ("Hopper-v5",),
        ("FetchPickAndPlace-v4", "gymnasium_robotics"),
    ],
    ids=lambda param: param[0],
)
def pair(request: pytest.FixtureRequest) -> Iterator[list[GymnasiumWorld]]:
    """Two worlds of one environment, with pictures: classic control, a table of texts, MuJoCo."""
    name, *imports = request.param
    worlds = [make(name, 24, 40, *imports) for _ in range(2)]
    yield worlds
    for world in worlds:
        world.close()


def test_resets_and_steps_give_the_same_bytes_in_any_world_and_thread(
    pair: list[GymnasiumWorld],
) -> None:
    chosen = actions(pair[0], 6)

    def run(world: GymnasiumWorld, seed: int) -> list[Observation]:
        seen = [world.reset(layout=None, seed=seed)]
        return seen + [world.step(action).observation for action in chosen]

    expected = run(pair[0], 3)
    run(pair[0], 1 << 40)
    with ThreadPoolExecutor(1) as thread:
        in_a_thread = thread.submit(run, pair[0], 3).result(timeout=120)
    for again in (run(pair[0], 3), run(pair[1], 3), in_a_thread):
        assert all(same(*both) for both in zip(expected, again, strict=True))
    assert expected[0].image.shape == (24, 40, 3)
    assert expected[0].image.std() > 1.0
    assert len(expected[0].state) == len(pair[0].task.state)


def test_save_and_restore_are_exact(pair: list[GymnasiumWorld]) -> None:
    world, other = pair
    chosen = actions(world, 6)
    world.reset(layout=None, seed=3)
    saved_at = [world.step(action) for action in chosen[:3]][-1]
    saved = world.save()
    expected = [world.step(action) for action in chosen[3:]]
    other.reset(layout=None, seed=5)
    world.reset(layout=None, seed=6)
    assert same(world.restore(saved), saved_at.observation)
    for action, before in zip(chosen[3:], expected, strict=True):
        again = world.step(action)
        assert same(again.observation, before.observation)
        assert (again.reward, again.terminated) == (before.reward, before.terminated)


def test_a_picture_in_the_observation_is_the_image() -> None:
    making = Making({"render_mode": "rgb_array"}, gymnasium.wrappers.AddRenderObservation)
    task = offered(["CartPole-v1"], [], making, 50)["CartPole-v1"]
    assert (len(task.state), task.has_image) == (0, True)
    world = GymnasiumWorld(task, 400, 600)
    world.reset(layout=None, seed=1)
    first = world.step(np.array([1.0])).observation
    own: Any = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    own.reset(seed=1)
    own.step(1)
    assert np.array_equal(first.image, own.render())  # its own size: nothing is resized
    saved = world.save()
    world.step(np.array([0.0]))
    assert same(world.restore(saved), first)
    half = GymnasiumWorld(task, 200, 300).reset(layout=None, seed=1).image
    assert half.shape == (200, 300, 3) and half.std() > 1.0


def test_a_space_becomes_numbers_and_numbers_a_value() -> None:
    described = dimensions_of(NESTED, "see")
    assert [dimension.name for dimension in described] == [
        "see.arm[0]",
        "see.arm[1]",
        "see.buttons[0]",
        "see.buttons[1]",
        "see.mode.0",
        "see.mode.1[0]",
        "see.mode.1[1]",
    ]
    assert described[0] == Dimension("see.arm[0]", -1.0, 1.0, False)
    assert described[1] == Dimension("see.arm[1]", None, None, False)
    assert described[4] == Dimension("see.mode.0", 1.0, 3.0, True)
    assert described[6] == Dimension("see.mode.1[1]", 0.0, 4.0, True)
    acts = spaces.Dict({key: NESTED[key] for key in ("arm", "buttons", "mode")})
    value = value_of(acts, np.array([0.5, -7.0, 1.0, 0.0, 3.0, 1.0, 4.0]))
    assert acts.contains(value)
    assert numbers_of(acts, value) == [0.5, -7.0, 1.0, 0.0, 3.0, 1.0, 4.0]


def test_a_return_that_reaches_the_threshold_is_success() -> None:
    """CartPole-v1 asks for a return of 475 of 500: pushing against the fall gets it."""
    world = make("CartPole-v1", 0, 0)
    state = world.reset(layout=None, seed=0).state
    for step in range(1, 501):
        force = float(state[2] + 0.3 * state[3] + 0.02 * state[0] + 0.05 * state[1] > 0)
        transition = world.step(np.array([force]))
        state = transition.observation.state
        assert transition.statistics.is_success == (step >= 475)
    assert transition.truncated and not transition.terminated
    assert transition.observation.image.shape == (0, 0, 3)


def test_what_is_wrong_is_said() -> None:
    with pytest.raises(InvalidReset, match="NoSuchWorld"):
        make("NoSuchWorld-v0", 0, 0)
    with pytest.raises(InvalidReset, match="package no_such_package"):
        make("CartPole-v1", 0, 0, "no_such_package")
    with pytest.raises(InvalidReset, match="expected MODULE:NAME"):
        imported("gymnasium.wrappers")
    world = make("CartPole-v1", 0, 0)
    with pytest.raises(InvalidAction, match="before reset"):
        world.step(np.array([0.0]))
    world.reset(layout=None, seed=0)
    with pytest.raises(InvalidReset, match="layout 2"):
        world.reset(layout=2, seed=0)
    for wrong, words in (
        ([0.0, 0.0], r"expected shape \(1,\)"),
        ([0.5], "expected a whole number from 0 to 1, got 0.5"),
        ([2.0], "from 0 to 1, got 2"),
    ):
        with pytest.raises(InvalidAction, match=words):
            world.step(np.array(wrong))
    while not world.step(np.array([0.0])).terminated:
        pass
    with pytest.raises(InvalidAction, match="it has ended"):
        world.step(np.array([0.0]))


def test_a_task_that_the_protocol_has_no_room_for_is_not_served() -> None:
    gymnasium.register("rever-tests/Wide-v0", entry_point=lambda **_: Wide())
    try:
        worlds = Worlds(offered(["rever-tests/Wide-v0"], [], Making(), 50), 1, GymnasiumWorld)
        network: Any = None
        with pytest.raises(ValueError, match="action: expected 1 to 128 numbers, got 200"):
            Server(network, worlds, ServerOptions())
    finally:
        del gymnasium.registry["rever-tests/Wide-v0"]


def test_what_was_seen_stays_as_it_was() -> None:
    gymnasium.register("rever-tests/Redrawn-v0", entry_point=lambda **_: Redrawn())
    try:
        world = make("rever-tests/Redrawn-v0", 16, 32)
        seen = [world.reset(layout=None, seed=0).image]
        seen += [world.step(np.array([0.0])).observation.image for _ in range(2)]
        assert [image.mean() for image in seen] == [0.0, 1.0, 2.0]
    finally:
        del gymnasium.registry["rever-tests/Redrawn-v0"]


def test_an_environment_that_breaks_or_does_not_repeat_itself_is_a_fault() -> None:
    gymnasium.register("rever-tests/Fickle-v0", entry_point=lambda **_: Fickle())
    try:
        world = make("rever-tests/Fickle-v0", 0, 0)
        with pytest.raises(InvalidReset, match="has no image"):
            make("rever-tests/Fickle-v0", 24, 40)
        world.reset(layout=None, seed=0)
        saved = world.save()
        with pytest.raises(NotReproducible, match="led to another state"):
            world.restore(saved)
        world.reset(layout=None, seed=0)
        with pytest.raises(PhysicsDiverged, match=r"observation\[0\] is nan"):
            world.step(np.array([1.0]))
        with pytest.raises(InvalidAction, match="before reset"):
            world.step(np.array([0.0]))
    finally:
        del gymnasium.registry["rever-tests/Fickle-v0"]


def test_an_environment_that_fails_when_it_is_made_or_closed_ends_no_server(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gymnasium.register("rever-tests/Sealed-v0", entry_point=lambda **_: Sealed())
    try:
        tasks = offered(["rever-tests/Sealed-v0"], [], Making(), 50)
        Sealed.is_broken = True
        worlds = Worlds(tasks, 0, GymnasiumWorld)
        key = ("rever-tests/Sealed-v0", "default", 0, 0)
        with pytest.raises(InvalidReset, match="Sealed-v0: OSError: no assets"):
            worlds.take(key)
        Sealed.is_broken = False
        world = worlds.take(key)
        Sealed.is_broken = True
        worlds.give_back(key, world)
        assert "cannot close a world" in caplog.text
    finally:
        del gymnasium.registry["rever-tests/Sealed-v0"]


def test_physics_that_started_anew_is_a_fault() -> None:
    """MuJoCo resets what has diverged by itself: nothing in the observation tells."""
    world = make("Hopper-v5", 0, 0)
    world.reset(layout=None, seed=0)
    still = np.zeros(len(world.task.action))
    world.step(still)
    environment: Any = world._environment.unwrapped
    environment.data.qvel[0] = 1e12
    with pytest.raises(PhysicsDiverged, match="mjWARN_BADQVEL"):
        world.step(still)
    world.reset(layout=None, seed=0)
    world.step(still)
