"""The Gymnasium environments: the checker's opinion, and the world behind them."""

import warnings
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rever_env  # noqa: F401  (registers the ids)
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
    action = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.0, -1.0])
    observation, reward, terminated, truncated, info = environment.step(action)
    transition = world.step(action)
    assert np.array_equal(observation["state"], transition.observation.state)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert list(info) == [field.name for field in fields(Statistics)]
    environment.close()


def test_unknown_options_are_refused(task: Task) -> None:
    environment = gymnasium.make(task.gymnasium_id)
    with pytest.raises(ValueError, match="expected only 'layout'"):
        environment.reset(options={"configuraton": 4})
    environment.close()


def test_a_variant_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(InvalidReset, match="default, paraphrase, distractors, got 'upside-down'"):
        gymnasium.make("rever/SpoonOnTowel-v1", variant="upside-down")


def test_asynchronous_vectors_draw_in_their_own_processes() -> None:
    vector: Any = gymnasium.make_vec(
        "rever_env:rever/SpoonOnTowel-v1", num_envs=2, vectorization_mode="async"
    )
    try:
        vector.reset_async(seed=3)
        observation, _ = vector.reset_wait(timeout=60.0)
        assert observation["image"].shape[0] == 2 and observation["image"].any()
    finally:
        vector.close(terminate=True)
