"""Environments in another process, as Gymnasium environments: real servers, real sockets."""

import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import free_endpoint
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import rever_env
from rever_env import protocol
from rever_env.remote_session import RemoteFault, RemoteRefused
from rever_env.tasks import Task
from rever_env.world import World

SPOON = "widowx_spoon_on_towel"
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)


def serve(endpoint: str, *arguments: str) -> "subprocess.Popen[str]":
    """A server process that is ready."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rever_env", "serve", "--listen", endpoint, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready ")
    return process


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    endpoint = free_endpoint()
    process = serve(endpoint)
    yield endpoint
    process.kill()
    process.wait()


def test_the_checker_passes_over_the_wire_without_a_warning(endpoint: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = gymnasium.make("rever_env:rever/Remote-v1", connect=endpoint)
        check_env(environment.unwrapped, skip_close_check=True)
        environment.close()


def test_a_gymnasium_environment_is_the_same_behind_a_server() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint, "--gymnasium", "CartPole-v1")
    remote = rever_env.RemoteEnv(endpoint, image_height=0, image_width=0)
    local = gymnasium.make("CartPole-v1")
    assert remote.session.task.task == "CartPole-v1"
    assert remote.action_space == gymnasium.spaces.Discrete(2)
    fields: Any = remote.observation_space
    assert fields["state"] == gymnasium.spaces.Box(
        np.array([-4.8, -np.inf, -0.41887903, -np.inf], np.float32),
        np.array([4.8, np.inf, 0.41887903, np.inf], np.float32),
    )
    observation, _ = remote.reset(seed=3)
    expected, _ = local.reset(seed=3)
    terminated = False
    while not terminated:
        assert set(observation) == {"state", "instruction"}
        assert np.array_equal(observation["state"], expected)
        action = int(expected[2] < 0.01)
        observation, reward, terminated, truncated, info = remote.step(np.int64(action))
        expected, *same = local.step(action)
        assert (reward, terminated, truncated) == tuple(same[:3])
        assert not info["is_success"]
    with pytest.raises(RemoteRefused, match="it has ended"):
        remote.step(np.int64(0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # CartPole's speeds have no bound, of which the checker warns there, too.
        warnings.filterwarnings("ignore", message=".*A Box observation space")
        made = gymnasium.make(
            "rever_env:rever/Remote-v1", connect=endpoint, image_height=0, image_width=0
        )
        check_env(made.unwrapped, skip_close_check=True)
    made.close()
    remote.close()
    process.kill()
    process.wait()


def test_a_session_that_the_server_ended_says_why_and_closes_at_once() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint)
    remote = rever_env.RemoteEnv(endpoint, SPOON, image_height=0, image_width=0)
    remote.reset(seed=1)
    remote.session._declared.pop().undeclare()  # the holder's token
    for _ in range(2):
        with pytest.raises(RemoteRefused, match="ended: its holder is gone"):
            remote.step(STILL)
    remote.close()
    process.kill()
    process.wait()


def test_it_is_the_same_world(endpoint: str, task: Task, world: World) -> None:
    remote = rever_env.RemoteEnv(endpoint, task.name, expert=True)
    observation, info = remote.reset(seed=9, options={"layout": 4})
    expected = world.reset(layout=4, seed=9)
    for _ in range(5):
        assert np.array_equal(observation["image"], expected.image)
        assert np.array_equal(observation["state"], expected.state)
        action = info["expert_action"]
        assert np.array_equal(action, world.expert_action().astype(np.float32))
        observation, _, _, _, info = remote.step(action)
        expected = world.step(action.astype(np.float64)).observation
    remote.close()


def test_an_episode_ends_at_the_horizon_and_refuses_more(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    remote.reset(seed=0)
    ends = [remote.step(STILL)[2:4] for _ in range(60)]
    assert ends == [(False, False)] * 59 + [(False, True)]
    with pytest.raises(RemoteRefused, match="step 61: expected at most 60"):
        remote.step(STILL)
    remote.reset(seed=0)
    remote.close()


def test_what_is_wrong_is_said(endpoint: str) -> None:
    with pytest.raises(RemoteRefused, match=r"expected one of the tasks .* got fold_towel"):
        rever_env.RemoteEnv(endpoint, "fold_towel")
    with pytest.raises(RemoteFault, match="cannot reach"):
        rever_env.RemoteEnv(free_endpoint(), wait_secs=0.5)
    remote = rever_env.RemoteEnv(endpoint)
    with pytest.raises(RemoteRefused, match="expected Reset first"):
        remote.step(STILL)
    with pytest.raises(ValueError, match=r"expected shape \(7,\), got \(6,\)"):
        remote.step(np.zeros(6, np.float32))
    with pytest.raises(ValueError, match="expected only 'layout'"):
        remote.reset(options={"configuraton": 4})
    for layout in (-1, 3.0, True, 1 << 32):
        with pytest.raises(ValueError, match="expected a whole number from 0 to 4294967295, got"):
            remote.reset(options={"layout": layout})
    with pytest.raises(RemoteRefused, match="layout 999: expected"):
        remote.reset(options={"layout": 999})
    remote.reset(seed=0, options={"layout": np.int64(3)})
    with pytest.raises(ValueError, match="expected finite numbers"):
        remote.step(np.full(7, np.nan, np.float32))
    remote.close()


def test_a_reply_that_cannot_be_understood_is_a_fault_and_no_reward(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=16, image_width=16)
    remote.reset(seed=0)
    transition = protocol.Transition(
        protocol.Observation(protocol.Image(32, 32, b""), (0.0,) * 8, "", None),
        protocol.Statistics(*[False] * 9),
        0.0,
        False,
        False,
    )
    unlike = protocol.REPLY.encode(protocol.Stepped(4, transition, (), 0))  # the fourth request
    session = remote.session
    key = str(session._publisher.key_expr).removesuffix("request") + "reply"
    for data, words in ((b"\xc1", "reply cannot be read"), (unlike, "16 x 16 pixels as before")):
        session._network.put(key, data)  # a server's, as far as anyone can tell
        with pytest.raises(RemoteFault, match=words):
            remote.step(STILL)
        remote.reset(seed=0)
    remote.step(STILL)
    remote.close()


def test_no_step_follows_one_whose_reply_was_not_taken(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=16, image_width=16)
    first, _ = remote.reset(seed=0)
    remote.send_step(STILL)  # and interrupted, by a user for instance
    with pytest.raises(RemoteFault, match="expected Reset after a request whose reply was not"):
        remote.step(STILL)
    assert np.array_equal(remote.reset(seed=0)[0]["image"], first["image"])
    remote.step(STILL)
    remote.close()


def test_a_wrong_action_moves_no_environment_of_a_vector(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.DISABLED)
    seeds: Any = [5, 6]
    environments.reset(seed=seeds)
    actions = np.tile(STILL, (2, 1))
    actions[1, 0] = np.nan
    with pytest.raises(ValueError, match="expected finite numbers"):
        environments.step(actions)
    observation, *_ = run(environments, 1)
    alone = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    alone.reset(seed=5)
    assert np.array_equal(observation["state"][0], alone.step(STILL)[0]["state"])
    alone.close()
    environments.close()


def test_a_killed_server_is_a_fault_and_no_reward() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint)
    remote = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    remote.reset(seed=0)
    process.kill()
    process.wait()
    with pytest.raises(RemoteFault):
        remote.step(STILL)
    remote.close()


def vector(endpoint: str, mode: AutoresetMode) -> rever_env.RemoteVectorEnv:
    return rever_env.RemoteVectorEnv(
        endpoint, 2, autoreset_mode=mode, image_height=8, image_width=8
    )


def run(environments: rever_env.RemoteVectorEnv, steps: int) -> tuple[Any, ...]:
    result: tuple[Any, ...] = ()
    for _ in range(steps):
        result = environments.step(np.tile(STILL, (2, 1)))
    return result


def test_a_vector_is_its_environments(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.DISABLED)
    seeds: Any = [5, 6]
    together, infos = environments.reset(seed=seeds)
    assert infos["seed"].tolist() == [5, 6]
    stepped = run(environments, 2)
    alone = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    for index in range(2):
        first, _ = alone.reset(seed=5 + index)
        assert np.array_equal(together["image"][index], first["image"])
        alone.step(STILL)
        observation, *_ = alone.step(STILL)
        assert np.array_equal(stepped[0]["state"][index], observation["state"])
    alone.close()
    environments.close()


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


def test_autoreset_begins_at_the_next_step_or_the_same(endpoint: str) -> None:
    environments = vector(endpoint, AutoresetMode.NEXT_STEP)
    environments.reset(seed=0)
    assert run(environments, 60)[3].tolist() == [True, True]
    _, rewards, _, truncated, infos = run(environments, 1)
    assert truncated.tolist() == [False, False] and rewards.tolist() == [0.0, 0.0]
    assert infos["_seed"].all() and "is_success" not in infos
    environments.close()
    environments = vector(endpoint, AutoresetMode.SAME_STEP)
    environments.reset(seed=0)
    observation, _, _, truncated, infos = run(environments, 60)
    assert truncated.tolist() == [True, True]
    last = infos["final_obs"][0]
    assert not np.array_equal(last["image"], observation["image"][0])
    environments.close()


def test_make_vec_deals_environments_out(endpoint: str) -> None:
    environments: Any = gymnasium.make_vec(
        "rever_env:rever/Remote-v1", num_envs=3, connect=[endpoint, endpoint], task=SPOON
    )
    observation, _ = environments.reset(seed=0)
    assert observation["image"].shape == (3, 128, 128, 3)
    assert environments.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    environments.close()


def test_lerobot_finds_its_environments(endpoint: str) -> None:
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    import env

    for cfg in (None, SimpleNamespace(connect=endpoint, image_side=32)):
        suites = env.make_env(n_envs=2, cfg=cfg)
        for environments in suites["rever"].values():
            seeds: Any = [1, 2]
            observation, infos = environments.reset(seed=seeds)
            side = 256 if cfg is None else 32
            assert observation["pixels"].shape == (2, side, side, 3)
            assert observation["agent_pos"].shape == (2, 8)
            assert infos["is_success"].tolist() == [False, False]
            first: Any = environments
            assert first.envs[0].unwrapped.task_description
            environments.close()


def test_the_example_of_the_readme_runs(endpoint: str) -> None:
    readme = Path(__file__).resolve().parents[2] / "README.md"
    (block,) = [
        block.removeprefix("python\n")
        for block in readme.read_text(encoding="utf-8").split("```")
        if block.startswith("python\n") and "rever/Remote-v1" in block
    ]
    lines = [line for line in block.splitlines() if line.strip()]
    assert len(lines) <= 10
    names: dict[str, Any] = {}
    exec(block.replace("tcp/127.0.0.1:7447", endpoint), names)
    assert names["info"]["is_success"] in (True, False) and names["truncated"]
