"""Vectors of remote environments: Gymnasium's conventions, over sessions of real servers."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import TASKS, end, free_endpoint, serve, served
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import rever_env
from rever_env import RemoteFault, RemoteVectorEnv, RemoteVectorFault

CUBE, SPOON = "widowx_stack_cube", "widowx_spoon_on_towel"
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
SMALL: dict[str, Any] = {"image_height": 8, "image_width": 8}


def vector(endpoint: str, mode: AutoresetMode | str) -> RemoteVectorEnv:
    return RemoteVectorEnv(endpoint, 2, autoreset_mode=mode, **SMALL)


def run(environments: Any, steps: int) -> tuple[Any, ...]:
    result: tuple[Any, ...] = ()
    for _ in range(steps):
        result = environments.step(np.tile(STILL, (environments.num_envs, 1)))
    return result


def test_a_vector_is_its_environments(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.DISABLED)
    seeds: Any = np.array([5, 6])
    together, infos = environments.reset(seed=seeds)
    assert infos["seed"].tolist() == [5, 6]
    assert environments.reset(seed=np.int64(5))[1]["seed"].tolist() == [5, 6]
    stepped = run(environments, 2)
    alone = rever_env.RemoteEnv(endpoint, **SMALL)
    for index in range(2):
        first, _ = alone.reset(seed=5 + index)
        assert np.array_equal(together["image"][index], first["image"])
        alone.step(STILL)
        observation, *_ = alone.step(STILL)
        assert np.array_equal(stepped[0]["state"][index], observation["state"])
    alone.close()
    environments.close()


def test_a_wrong_action_moves_no_environment_of_a_vector(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.DISABLED)
    environments.reset(seed=5)
    actions = np.tile(STILL, (2, 1))
    actions[1, 0] = np.nan
    with pytest.raises(ValueError, match="environment 1: action: expected finite numbers"):
        environments.step(actions)
    with pytest.raises(ValueError, match="actions: expected 2, got 3"):
        environments.step(np.tile(STILL, (3, 1)))
    observation, *_ = run(environments, 1)
    alone = rever_env.RemoteEnv(endpoint, **SMALL)
    alone.reset(seed=5)
    assert np.array_equal(observation["state"][0], alone.step(STILL)[0]["state"])
    alone.close()
    environments.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_results_are_those_of_gymnasiums_own_vectors(endpoint: str, mode: AutoresetMode) -> None:
    """Over an episode's end: the same observations, rewards, infos, final_obs and final_info."""
    own: Any = vector(endpoint, mode.value)  # as text
    assert own.metadata["autoreset_mode"] is mode
    theirs: Any = SyncVectorEnv(
        [lambda: rever_env.BridgeEnv(SPOON, **SMALL)] * 2, autoreset_mode=mode
    )
    for environments in (own, theirs):
        environments.reset(seed=[1, 2])
    for step in range(62 if mode != AutoresetMode.DISABLED else 60):
        results = [run(environments, 1) for environments in (own, theirs)]
        if step > 57:
            assert_same(*results)
    assert own.metadata == {**theirs.metadata}
    own.close()
    theirs.close()


def assert_same(one: Any, other: Any) -> None:
    """Recursively, with the types of arrays."""
    if isinstance(one, dict):
        assert list(sorted(one)) == list(sorted(other))
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        assert len(one) == len(other)
        for part, its in zip(one, other, strict=True):
            assert_same(part, its)
    else:
        assert np.array_equal(one, other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)


def test_without_autoreset_the_mask_says_which_begin_again(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.DISABLED)
    environments.reset(seed=0)
    assert run(environments, 60)[3].tolist() == [True, True]
    with pytest.raises(ValueError, match=r"environments \[0, 1\] have ended"):
        run(environments, 1)
    environments.reset(seed=1, options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match=r"environments \[1\] have ended"):
        run(environments, 1)
    environments.close()


def test_autoreset_modes_are_named_as_gymnasium_names_them(endpoint: str) -> None:
    with pytest.raises(ValueError, match="samestep"):
        vector(endpoint, "samestep")


def test_environments_can_be_asked_and_set(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.SAME_STEP)
    assert environments.render_mode == "rgb_array"
    assert environments.render() == (None, None)  # nothing is seen before the first reset
    environments.reset(seed=0)
    images = environments.render()
    assert images is not None and [image.shape for image in images] == [(8, 8, 3)] * 2
    assert environments.call("checked", STILL)[1].tolist() == STILL.tolist()
    environments.set_attr("label", ["a", "b"])
    assert environments.get_attr("label") == ("a", "b")
    environments.set_attr("label", 3)
    assert environments.call("label") == (3, 3)
    with pytest.raises(ValueError, match="label: expected 2 values, got 1"):
        environments.set_attr("label", [1])
    environments.close()
    with pytest.raises(ClosedEnvironmentError):
        environments.reset()


def test_gymnasiums_wrappers_of_vectors_work(endpoint: str) -> None:
    environments: Any = RecordEpisodeStatistics(vector(endpoint, AutoresetMode.SAME_STEP))
    environments.reset(seed=0)
    infos = run(environments, 60)[4]
    assert infos["episode"]["l"].tolist() == [60, 60]
    assert [image.shape for image in environments.render()] == [(8, 8, 3)] * 2
    environments.close()


def test_make_vec_deals_environments_out(endpoint: str) -> None:
    environments: Any = gymnasium.make_vec(
        "rever_env:rever/Remote-v1", num_envs=3, connect=[endpoint, endpoint], task=SPOON
    )
    observation, _ = environments.reset(seed=0)
    assert observation["image"].shape == (3, 128, 128, 3)
    assert environments.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert environments.metadata["render_fps"] == 5
    environments.close()


def test_each_environment_may_have_its_own_task(endpoint: str) -> None:
    environments = RemoteVectorEnv(endpoint, task=[CUBE, SPOON, CUBE], **SMALL)
    expected = tuple(TASKS[name].instruction for name in (CUBE, SPOON, CUBE))
    for _ in range(2):
        observation, _ = environments.reset(seed=0)
        assert observation["instruction"] == expected
        assert run(environments, 1)[0]["instruction"] == expected
    environments.close()
    with pytest.raises(ValueError, match="task: expected one or 3, got 2"):
        RemoteVectorEnv(endpoint, 3, task=[CUBE, SPOON])


def test_instructions_and_images_arrive_by_gymnasiums_vectors(endpoint: str) -> None:
    for kind, arguments in (("sync", {}), ("async", {"context": "forkserver"})):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            environments: Any = gymnasium.make_vec(
                "rever_env:rever/Remote-v1",
                num_envs=2,
                vectorization_mode=kind,
                vector_kwargs=arguments,
                connect=endpoint,
                task=CUBE,
                **SMALL,
            )
        observation, _ = environments.reset(seed=0)
        assert observation["instruction"] == (TASKS[CUBE].instruction,) * 2
        assert observation["image"].any()
        assert environments.metadata["render_fps"] == 5
        environments.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_dead_server_costs_its_own_environments_only(mode: AutoresetMode, endpoint: str) -> None:
    with served() as (own, process):
        both: Any = RemoteVectorEnv([endpoint, own], 4, autoreset_mode=mode, **SMALL)
        alone: Any = RemoteVectorEnv(endpoint, 4, autoreset_mode=mode, **SMALL)
        for environments in (both, alone):
            environments.reset(seed=3)
            run(environments, 2)
        end(process)
        for _ in range(3):
            expected = run(alone, 1)
            with pytest.raises(RemoteVectorFault, match=r"environment 1: .*; environment 3: "):
                run(both, 1)
        with pytest.raises(RemoteVectorFault) as fault:
            run(both, 1)
        expected = run(alone, 1)
        assert sorted(fault.value.faults) == [1, 3]
        assert all(isinstance(one, RemoteFault) for one in fault.value.faults.values())
        observation, rewards, terminated, truncated, infos = fault.value.results
        for index in (0, 2):
            assert np.array_equal(observation["image"][index], expected[0]["image"][index])
            assert np.array_equal(observation["state"][index], expected[0]["state"][index])
        assert np.isnan(rewards).tolist() == [False, True, False, True]
        assert not terminated.any() and not truncated.any()
        assert infos["_is_success"].tolist() == [True, False, True, False]
        assert infos["_fault"].tolist() == [False, True, False, True]
        both.close()
        alone.close()


def test_a_server_that_came_back_gets_its_environments_back(endpoint: str) -> None:
    own = free_endpoint()
    process = serve(own)
    environments: Any = RemoteVectorEnv([endpoint, own], **SMALL)
    environments.reset(seed=3)
    first = environments.envs[1].session.server
    end(process)
    with pytest.raises(RemoteVectorFault, match=rf"environment 1: server {first} at \S+ is gone"):
        run(environments, 1)
    with pytest.raises(RemoteVectorFault, match=r"environment 1: .*connection refused") as fault:
        environments.reset(seed=3)
    assert fault.value.results[1]["_seed"].tolist() == [True, False]
    process = serve(own)
    try:
        _, rewards, _, _, infos = run(environments, 1)
        assert infos["_seed"].tolist() == [False, True] and rewards.tolist() == [0.0, 0.0]
        assert environments.envs[1].session.server != first
        assert "_fault" not in run(environments, 1)[4]
        environments.close()
    finally:
        end(process)
