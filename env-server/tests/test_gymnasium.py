"""The Gymnasium environments: the checker's opinion, the world behind them, what users may pass."""

import copy
import pickle
import warnings
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import TASKS
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import rever_env
from rever_env.fault import InvalidReset
from rever_env.protocol import Statistics
from rever_env.tasks import Task
from rever_env.world import World

IDS = {
    "widowx_spoon_on_towel": "rever/SpoonOnTowel-v1",
    "widowx_carrot_on_plate": "rever/CarrotOnPlate-v1",
    "widowx_stack_cube": "rever/StackCube-v1",
    "widowx_put_eggplant_in_basket": "rever/EggplantInBasket-v1",
}
CUBE, SPOON = "widowx_stack_cube", "widowx_spoon_on_towel"
SMALL: dict[str, Any] = {"image_height": 16, "image_width": 16}


def test_the_checker_passes_without_a_warning(task: Task) -> None:
    assert task.gymnasium_id == IDS[task.name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = gymnasium.make(task.gymnasium_id, variant=task.variant)
        check_env(environment.unwrapped)
        environment.close()


def test_it_is_the_same_world(task: Task, world: World) -> None:
    environment = gymnasium.make(task.gymnasium_id, variant=task.variant)
    observation, info = environment.reset(seed=9, options={"layout": 4})
    expected = world.reset(layout=4, seed=9)
    assert np.array_equal(observation["image"], expected.image)
    assert observation["instruction"] == task.instruction and info == {"seed": 9}
    action = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.0, -1.0], np.float32)
    observation, reward, terminated, truncated, info = environment.step(action)
    transition = world.step(action.astype(np.float64))
    assert np.array_equal(observation["state"], transition.observation.state)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert list(info) == [*(field.name for field in fields(Statistics)), "action_followed"]
    environment.close()


def test_unknown_options_are_refused(task: Task) -> None:
    environment = gymnasium.make(task.gymnasium_id, variant=task.variant)
    with pytest.raises(ValueError, match="expected only 'layout'"):
        environment.reset(options={"configuraton": 4})
    environment.close()


def test_a_variant_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(InvalidReset, match="default, paraphrase, distractors, got 'upside-down'"):
        gymnasium.make("rever/SpoonOnTowel-v1", variant="upside-down")


def test_all_tasks_have_the_same_spaces() -> None:
    environments = [rever_env.BridgeEnv(*task.id, **SMALL) for task in TASKS.values()]
    first = environments[0]
    for environment in environments:
        assert environment.observation_space == first.observation_space
        assert environment.action_space == first.action_space
        observation, _ = environment.reset(seed=0)
        assert observation in first.observation_space
        environment.close()
    assert isinstance(first.action_space, gymnasium.spaces.Box)
    assert first.action_space.dtype == np.float32
    assert first.action_space.high.tolist() == pytest.approx([0.05] * 3 + [0.25] * 3 + [1.0])


def test_sampled_actions_move_the_gripper() -> None:
    environment = rever_env.BridgeEnv(CUBE, image_height=0, image_width=0)
    environment.action_space.seed(0)
    moved = []
    for seed in range(5):
        observation, _ = environment.reset(seed=seed)
        for _ in range(20):
            before = observation["state"][:3]
            observation, *_ = environment.step(environment.action_space.sample())
            moved.append(float(np.linalg.norm(observation["state"][:3] - before)))
    assert np.mean(np.array(moved) > 0.001) > 0.8  # metres
    environment.close()


def test_an_action_that_is_not_followed_is_told() -> None:
    """The numbers beyond the space's bounds are taken, as policies with other limits need it."""
    environment = rever_env.BridgeEnv(CUBE, image_height=0, image_width=0)
    for move, followed in (((0.03, 0, 0), True), ((0, 0.2, 0), True), ((0, 0.5, 0), False)):
        before = environment.reset(seed=0)[0]["state"]
        action = np.array([*move, 0, 0, 0, 1], np.float32)
        after, _, _, _, info = environment.step(action)
        assert info["action_followed"] is followed
        moved = float(np.linalg.norm(after["state"][:3] - before[:3]))
        assert (moved > 0.01) is followed
    # The commanded pose stays out of reach until actions bring it back.
    still, back = np.array([0.0] * 6 + [1.0]), np.array([0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert environment.step(still)[4]["action_followed"] is False
    assert environment.step(back)[4]["action_followed"] is True
    turn = np.array([0.0, 0.0, 0.0, 0.0, 3.0, 0.0, 1.0])
    assert environment.step(turn)[4]["action_followed"] is False
    environment.close()


def test_the_expert_is_followed_but_for_what_it_touches(task: Task, world: World) -> None:
    environment = rever_env.BridgeEnv(*task.id, image_height=0, image_width=0)
    environment.reset(seed=3)
    followed = []
    for _ in range(30):
        action = environment.world.expert_action()
        followed.append(environment.step(action.astype(np.float32))[4]["action_followed"])
    assert np.mean(followed) > 0.9
    environment.close()


def test_environments_without_images_have_none() -> None:
    environment = rever_env.BridgeEnv(CUBE, image_height=0, image_width=0)
    observation, _ = environment.reset(seed=0)
    assert set(observation) == {"state", "instruction"}
    assert observation in environment.observation_space
    assert environment.render_mode is None and environment.render() is None
    environment.close()


@pytest.mark.parametrize(
    ("height", "width", "words"),
    [
        (-5, 64, "image_height: expected a whole number from 0 to 1024, got -5"),
        (64.0, 64, "image_height: expected a whole number from 0 to 1024, got 64.0"),
        (64, 1025, "image_width: expected a whole number from 0 to 1024, got 1025"),
        (64, True, "image_width: expected a whole number from 0 to 1024, got True"),
        (0, 64, "expected both sides 0"),
    ],
)
def test_wrong_sizes_are_refused(height: Any, width: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        rever_env.BridgeEnv(CUBE, image_height=height, image_width=width)
    with pytest.raises(ValueError, match=words):  # before anything is sought
        rever_env.RemoteEnv("tcp/127.0.0.1:1", image_height=height, image_width=width)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (np.zeros(6), r"expected shape \(7,\), got \(6,\)"),
        (np.full(7, np.nan), "expected finite numbers"),
        (np.full(7, 1e39), "expected finite numbers"),
        (["a"] * 7, "expected numbers"),
        (None, "expected numbers"),
    ],
)
def test_wrong_actions_are_refused(action: Any, words: str, endpoint: str) -> None:
    local = rever_env.BridgeEnv(CUBE, **SMALL)
    remote = rever_env.RemoteEnv(endpoint, CUBE, **SMALL)
    for environment in (local, remote):
        environment.reset(seed=0)
        with pytest.raises(ValueError, match=words):
            environment.step(action)
        environment.step(np.zeros(7, np.float32))
        environment.close()


def test_wrong_names_and_seeds_are_refused() -> None:
    with pytest.raises(InvalidReset, match=r"one of the tasks widowx_spoon_on_towel, .* 'bogus'"):
        rever_env.BridgeEnv("bogus")
    environment = rever_env.BridgeEnv(CUBE, **SMALL)
    for seed in (-1, 1.0, 1 << 53):
        with pytest.raises(ValueError, match=r"seed: expected a whole number from 0 to 9007199254"):
            environment.reset(seed=seed)  # type: ignore[arg-type]
    numpys: Any = np.int64(7)
    assert environment.reset(seed=numpys)[1] == {"seed": 7}
    environment.close()


def test_images_are_writable_and_render_gives_a_copy() -> None:
    environment = rever_env.BridgeEnv(CUBE, **SMALL)
    observation, _ = environment.reset(seed=0)
    rendered = environment.render()
    assert rendered is not None and np.array_equal(rendered, observation["image"])
    rendered[:] = 0
    again = environment.render()
    assert again is not None and np.array_equal(again, observation["image"]) and again.any()
    observation["image"] += 1
    environment.close()


def test_closed_environments_say_so() -> None:
    environment = rever_env.BridgeEnv(CUBE, **SMALL)
    environment.reset(seed=0)
    environment.close()
    environment.close()
    with pytest.raises(ClosedEnvironmentError, match="close"):
        environment.step(np.zeros(7, np.float32))
    with pytest.raises(ClosedEnvironmentError, match="close"):
        environment.reset()


def test_environments_can_be_copied_and_pickled(endpoint: str) -> None:
    local = rever_env.BridgeEnv(CUBE, **SMALL)
    remote = rever_env.RemoteEnv(endpoint, CUBE, **SMALL)
    for environment in (local, remote):
        first = environment.reset(seed=5)[0]
        for other in (pickle.loads(pickle.dumps(environment)), copy.deepcopy(environment)):
            assert np.array_equal(other.reset(seed=5)[0]["image"], first["image"])
            other.close()
        environment.close()


def maker(index: int) -> Any:
    """Two tasks in turn."""
    return rever_env.BridgeEnv((CUBE, SPOON)[index % 2], **SMALL)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("kind", ["sync", "fork", "forkserver", "copies"])
def test_instructions_arrive_by_every_vectorisation(kind: str, mode: AutoresetMode) -> None:
    makers = [lambda: maker(0), lambda: maker(1)]
    vector: Any = (
        SyncVectorEnv(makers, autoreset_mode=mode)
        if kind == "sync"
        else AsyncVectorEnv(
            makers,
            autoreset_mode=mode,
            context="fork" if kind == "copies" else kind,
            shared_memory=kind != "copies",
        )
    )
    expected = (TASKS[CUBE].instruction, TASKS[SPOON].instruction)
    try:
        observation, _ = vector.reset(seed=0)
        assert observation["instruction"] == expected and observation["image"].any()
        assert observation in vector.observation_space
        observation, *_ = vector.step(vector.action_space.sample())
        assert observation["instruction"] == expected
        assert vector.metadata["render_fps"] == 5
    finally:
        vector.close()


def test_asynchronous_vectors_draw_in_their_own_processes() -> None:
    vector: Any = gymnasium.make_vec(
        "rever_env:rever/SpoonOnTowel-v1", num_envs=2, vectorization_mode="async"
    )
    try:
        vector.reset_async(seed=3)
        observation, _ = vector.reset_wait(timeout=60.0)
        assert observation["image"].shape[0] == 2 and observation["image"].any()
        assert observation["instruction"] == (TASKS[SPOON].instruction,) * 2
    finally:
        vector.close(terminate=True)
