"""What LeRobot reports of the vectors that env.py gives it, by the rules of its own evaluation."""

import importlib.util
import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import TASKS
from numpy.typing import NDArray

from rever_env.lerobot import LeRobotEnv
from rever_env.tasks import choose
from rever_env.world import World

CUBE = "widowx_stack_cube"
SEEDS = [100, 101]
Rule = Callable[[dict[str, Any], int], list[bool]]


def hub_module() -> Any:
    """env.py as LeRobot imports it: by its path, under a name that no other process can import."""
    path = Path(__file__).resolve().parent.parent / "env.py"
    spec = importlib.util.spec_from_file_location("hub_env_user_rever", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rule_of_0_4(info: dict[str, Any], count: int) -> list[bool]:
    """rollout() of lerobot/scripts/lerobot_eval.py, version 0.4.4."""
    if "final_info" in info:
        successes: list[bool] = info["final_info"]["is_success"].tolist()
        return successes
    return [False] * count


def rule_of_0_6(info: dict[str, Any], count: int) -> list[bool]:
    """The same, version 0.6.1."""
    if "final_info" in info:
        successes: list[bool] = info["final_info"].get("is_success", [False] * count).tolist()
        return successes
    if "is_success" in info:
        steps: list[bool] = info["is_success"].tolist()
        return steps
    return [False] * count


def evaluated(vector: Any, actions: NDArray[np.float32], rule: Rule) -> list[bool]:
    """The successes that eval_policy() counts: any step until one after the episode's end."""
    observation, _ = vector.reset(seed=SEEDS)
    count = vector.num_envs
    done = np.zeros(count, np.bool_)
    dones, successes = [], []
    step = 0
    while not done.all() and step < vector.call("_max_episode_steps")[0]:
        assert vector.call("task_description") == (TASKS[CUBE].instruction,) * count
        assert observation["pixels"].dtype == np.uint8 and observation["agent_pos"].shape[1] == 8
        observation, _, terminated, truncated, info = vector.step(actions[:, step])
        done = terminated | truncated | done
        dones.append(done)
        successes.append(rule(info, count))
        step += 1
    ends = np.argmax(np.array(dones).astype(np.int64), axis=0)  # (environments,)
    counted = np.arange(step)[:, None] <= ends + 1  # (steps, environments)
    return [bool(one) for one in (np.array(successes) & counted).any(axis=0)]


def expert_actions(*, is_spoilt: bool) -> NDArray[np.float32]:
    """Float32 (seeds, 60, 7): the expert stacks cubes; spoilt, the arm then knocks them over."""
    episodes = []
    with World(TASKS[CUBE], 0, 0) as world:
        for seed in SEEDS:
            world.reset(layout=None, seed=seed)
            actions, flags = [], []
            for step in range(60):
                action = world.expert_action()
                if is_spoilt and step >= 44:
                    move = (0.0, 0.0, -0.02) if step < 49 else (0.0, 0.04, 0.0)
                    action = np.array([*move, 0.0, 0.0, 0.0, -1.0])
                action = action.astype(np.float32)
                flags.append(world.step(action.astype(np.float64)).statistics.is_success)
                actions.append(action)
            assert any(flags) and flags[-1] is not is_spoilt
            episodes.append(actions)
    return np.array(episodes, np.float32)


@pytest.mark.parametrize(("is_remote", "is_asynchronous"), [(False, False), (True, True)])
def test_lerobot_reports_success_at_the_last_step(
    is_remote: bool, is_asynchronous: bool, endpoint: str
) -> None:
    cfg = SimpleNamespace(connect=endpoint if is_remote else None, image_side=16, tasks=[CUBE])
    ((suite, vectors),) = hub_module().make_env(2, is_asynchronous, cfg=cfg).items()
    assert suite == "rever" and list(vectors) == [0]
    try:
        for is_spoilt in (False, True):
            actions = expert_actions(is_spoilt=is_spoilt)
            for rule in (rule_of_0_4, rule_of_0_6):
                assert evaluated(vectors[0], actions, rule) == [not is_spoilt] * 2
    finally:
        vectors[0].close()


def test_lerobot_gets_every_task(endpoint: str) -> None:
    for cfg, side in ((None, 256), (SimpleNamespace(connect=endpoint, image_side=32), 32)):
        vectors = hub_module().make_env(n_envs=2, use_async_envs=False, cfg=cfg)["rever"]
        assert list(vectors) == [0, 1, 2, 3]
        for task, vector in zip(choose(TASKS, None), vectors.values(), strict=True):
            observation, infos = vector.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
            assert observation["pixels"].shape == (2, side, side, 3)
            assert observation["agent_pos"].shape == (2, 8)
            assert infos["is_success"].tolist() == [False, False]
            assert vector.unwrapped.metadata["render_fps"] == 5
            assert [one.shape for one in vector.call("render")] == [(side, side, 3)] * 2
            assert vector.envs[0].unwrapped.task == task.name
            assert vector.envs[0].unwrapped.task_description == task.instruction
            vector.close()


def test_lerobots_environments_can_be_pickled() -> None:
    environment = LeRobotEnv(CUBE, image_side=16)
    first = environment.reset(seed=1)[0]
    other = pickle.loads(pickle.dumps(environment))
    assert np.array_equal(other.reset(seed=1)[0]["pixels"], first["pixels"])
    assert other.action_space == environment.action_space
    other.close()
    environment.close()
