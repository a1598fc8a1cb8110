"""What a served Gymnasium environment says of itself arrives, and its promises are tried."""

import argparse
import logging
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env.fault import InvalidReset
from rever_env.gymnasium_tasks import GymnasiumTask, Keys, Making, offered
from rever_env.gymnasium_trial import tried
from rever_env.gymnasium_world import GymnasiumWorld
from rever_env.simulators import UnusedOption, add_arguments, make_worlds

ID = "rever-tests/Cup-v0"
TEXT = spaces.Text(40, charset="abcdefghijklmnopqrstuvwxyz 0123456789")


class Cup(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """Two cameras, a state of two parts, and another instruction in each episode.

    Gymnasium sorts the parts by their names.
    """

    observation_space = spaces.Dict(
        {
            "front": spaces.Box(0, 255, (4, 6, 3), np.uint8),
            "images": spaces.Dict({"wrist": spaces.Box(0, 255, (4, 6, 3), np.uint8)}),
            "state": spaces.Box(-1.0, 1.0, (3,)),
            "joints": spaces.Box(-2.0, 2.0, (2,)),
            "task": TEXT,
            "language": TEXT,
        }
    )
    action_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (2,))

    def __init__(self) -> None:
        self.metadata = {"render_modes": [], "render_fps": np.int64(20)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.cup = int(self.np_random.integers(100))
        self.steps = 0
        return self._observation(), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        self.steps += 1
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> dict[str, Any]:
        return {
            "front": np.full((4, 6, 3), 1, np.uint8),
            "images": {"wrist": np.full((4, 6, 3), 2, np.uint8)},
            "state": np.array([0.1, 0.2, 0.3], np.float32),
            "joints": np.array([1.0, self.steps / 100.0], np.float32),
            "task": f"lift cup {self.cup}",
            "language": f"take cup {self.cup}",
        }


class Told(gymnasium.Env[NDArray[np.float32], int]):
    """Says its instruction in an attribute; can relabel goals; is asked to misbehave by name."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space: spaces.Space[Any] = spaces.Discrete(2)
    total_resets = 0

    def __init__(self, fault: str = "", render_mode: str | None = None) -> None:
        self.metadata = {"render_modes": ["rgb_array"]}
        self.fault = fault
        self.render_mode = render_mode
        self.resets = 0

    @property
    def task_description(self) -> str:
        return f"do it in episode {self.resets}"

    def compute_reward(self) -> float:
        return 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.resets += 1
        Told.total_resets += 1
        if self.fault == "reset":
            raise ValueError("no scene")
        return self._observation(), {}

    def step(self, action: int) -> Any:
        if self.fault == "step":
            raise RuntimeError("out of memory")
        return self._observation(), 0.0, False, False, {}

    def render(self) -> Any:
        if self.fault == "render":
            raise RuntimeError("no display")
        return np.zeros((8, 8, 3), np.uint8)

    def _observation(self) -> NDArray[np.float32]:
        count = {"instance": id(self) % 1009, "episode": self.resets}.get(self.fault, 0)
        return np.array([count], np.float32)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Ids that only these tests know."""
    gymnasium.register(ID, entry_point=lambda **_: Cup(), max_episode_steps=30)
    gymnasium.register("rever-tests/Told-v0", entry_point=lambda **arguments: Told(**arguments))
    yield
    del gymnasium.registry[ID], gymnasium.registry["rever-tests/Told-v0"]


def cup(keys: Keys | None = None) -> GymnasiumTask:
    return offered([ID], [], Making(), 50, keys)[ID]


def told(fault: str = "") -> GymnasiumTask:
    name = "rever-tests/Told-v0"
    return offered([name], [], Making({"fault": fault}), 50)[name]


def test_each_episodes_instruction_arrives() -> None:
    task = cup()
    world = GymnasiumWorld(task, 4, 6)
    own = Cup()
    for seed in (0, 1, 2):
        expected = own.reset(seed=seed)[0]["language"]
        assert world.reset(layout=None, seed=seed).instruction == expected
        assert world.step(np.zeros(2)).observation.instruction == expected
    assert task.instruction == own.reset(seed=0)[0]["language"]
    assert task.control_hz == 20.0


def test_an_instruction_outside_the_observation_arrives() -> None:
    task = told()
    world = GymnasiumWorld(task, 0, 0)
    assert world.reset(layout=None, seed=0).instruction == "do it in episode 1"
    assert world.step(np.zeros(1)).observation.instruction == "do it in episode 1"
    assert world.reset(layout=None, seed=1).instruction == "do it in episode 2"
    assert task.control_hz is None


def test_an_environment_without_an_instruction_has_its_id() -> None:
    task = offered(["CartPole-v1"], [], Making(), 50)["CartPole-v1"]
    assert task.instruction == "CartPole-v1"
    assert GymnasiumWorld(task, 0, 0).reset(layout=None, seed=0).instruction == "CartPole-v1"


def test_a_camera_that_is_not_served_is_named(caplog: pytest.LogCaptureFixture) -> None:
    task = cup()
    assert "serving the image front of its observation, not images.wrist" in caplog.text
    assert "text language of its observation as the instruction, not task" in caplog.text
    assert GymnasiumWorld(task, 4, 6).reset(layout=None, seed=0).image.max() == 1
    names = [dimension.name.split("[")[0] for dimension in task.state]
    assert names == ["observation.joints"] * 2 + ["observation.state"] * 3


def test_keys_choose_parts_of_the_observation(caplog: pytest.LogCaptureFixture) -> None:
    task = cup(Keys("images.wrist", "task", ("state", "joints")))
    assert not caplog.text
    assert task.instruction.startswith("lift cup")
    world = GymnasiumWorld(task, 4, 6)
    world.reset(layout=None, seed=0)
    seen = world.step(np.zeros(2)).observation
    assert seen.image.min() == seen.image.max() == 2
    assert seen.state.tolist() == np.array([0.1, 0.2, 0.3, 1.0, 0.01], np.float32).tolist()
    assert task.state[3].name == "observation.joints[0]" and task.state[3].high == 2.0


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (Keys(image="wrist"), "image key wrist: expected one of front, images.wrist"),
        (Keys(instruction="state"), "instruction key state: expected one of language, task"),
        (Keys(state=("front",)), "state key front: expected one of joints, state"),
    ],
)
def test_keys_that_are_not_there_are_refused(keys: Keys, words: str) -> None:
    with pytest.raises(InvalidReset, match=words):
        cup(keys)
    with pytest.raises(InvalidReset, match=r"expected one of none .the observation has no such"):
        offered(["CartPole-v1"], [], Making(), 50, Keys(image="front"))


def test_a_sound_environment_gives_no_warning() -> None:
    for task in (cup(), told()):
        assert tried(task) == (task, [])


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("instance", "different observations in another instance: episodes are not reproducible"),
        ("episode", "different observations in the next episode: episodes are not reproducible"),
        ("step", "a reset and 5 random steps fail: RuntimeError: out of memory"),
    ],
)
def test_a_promise_that_is_broken_is_said(fault: str, words: str) -> None:
    task, warnings = tried(told(fault))
    assert len(warnings) == 1 and words in warnings[0]
    assert task.has_image


def test_an_environment_that_cannot_be_drawn_is_served_without_images() -> None:
    task, warnings = tried(told("render"))
    assert not task.has_image
    assert "served without images" in warnings[0] and "no display" in warnings[0]


def test_an_environment_that_cannot_be_reset_is_not_served() -> None:
    with pytest.raises(InvalidReset, match=r"reset\(seed=0\) failed: ValueError: no scene"):
        told("reset")


def test_what_the_network_cannot_reach_is_said(caplog: pytest.LogCaptureFixture) -> None:
    told()
    assert "compute_reward cannot be called over the network" in caplog.text


def parsed(line: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return parser.parse_args(line.split())


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "--control-hz 5",
            "--control-hz has no effect without --robosuite and one of robosuite's own",
        ),
        ("--horizon 9", "--horizon has no effect without --gymnasium, or --robosuite and"),
        ("--robosuite widowx_stack_cube --horizon 9", "--horizon has no effect without"),
        ("--robosuite widowx_stack_cube --robots UR5e", "--robots has no effect without"),
        ("--gymnasium CartPole-v1 --control-hz 5", "--control-hz has no effect without"),
        ("--gymnasium CartPole-v1 --horizon 9", "every environment has its own step limit"),
        ("--robosuite Lift --import somewhere", "--import has no effect without --gymnasium"),
        ("--image-key front", "--image-key has no effect without --gymnasium"),
        ("--state-keys a b", "--state-keys has no effect without --gymnasium"),
        ("--arguments {}", "--arguments has no effect without --gymnasium"),
    ],
)
def test_an_option_without_effect_is_refused(line: str, words: str) -> None:
    with pytest.raises(UnusedOption, match=words):
        make_worlds(parsed(line), 1)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--arguments notjson", "expected a JSON object, got notjson: Expecting value"),
        ("--arguments [1]", "expected a JSON object, got [1]"),
        ("--gymnasium a --horizon 0", "expected a positive whole number, got 0"),
        ("--gymnasium a --horizon ten", "expected a positive whole number, got ten"),
    ],
)
def test_a_value_that_cannot_be_read_is_refused(
    line: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit:
        parsed(line)
    assert exit.value.code == 2
    assert words in capsys.readouterr().err


def test_options_of_gymnasium_act(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    line = f"--gymnasium {ID} rever-tests/Told-v0 --horizon 7"
    worlds = make_worlds(parsed(line), 1)
    assert {task.name: task.steps_max for task in worlds.tasks.values()} == {
        ID: 30,
        "rever-tests/Told-v0": 7,
    }
    keys = parsed(f"--gymnasium {ID} --image-key images.wrist --state-keys joints")
    (task,) = make_worlds(keys, 1).tasks.values()
    assert len(task.state) == 2
