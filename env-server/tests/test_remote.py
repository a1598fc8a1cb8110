"""Environments in another process, as Gymnasium environments: real servers, real sockets."""

import os
import signal
import subprocess
import time
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import free_endpoint, pause, served
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils.env_checker import check_env

import rever_env
from rever_env import protocol
from rever_env.remote_session import RemoteFault, RemoteRefused
from rever_env.tasks import Task

SPOON = "widowx_spoon_on_towel"
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)


def test_the_checker_passes_over_the_wire_without_a_warning(endpoint: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = gymnasium.make("rever_env:rever/Remote-v1", connect=endpoint)
        check_env(environment.unwrapped, skip_close_check=True)
        environment.close()


def test_a_gymnasium_environment_is_the_same_behind_a_server() -> None:
    with served("--gymnasium", "CartPole-v1") as (endpoint, _):
        remote = rever_env.RemoteEnv(endpoint, image_height=0, image_width=0)
        local = gymnasium.make("CartPole-v1")
        assert remote.session.task.task == "CartPole-v1"
        assert remote.metadata["render_fps"] == local.metadata["render_fps"] == 50
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


def test_it_is_the_same_environment(endpoint: str, task: Task) -> None:
    """Spaces, observations and info, for actions of any size."""
    remote = rever_env.RemoteEnv(endpoint, task.name, task.variant, expert=True)
    local = rever_env.BridgeEnv(*task.id)
    assert remote.session.task.variant == task.variant
    assert remote.observation_space == local.observation_space
    assert remote.action_space == local.action_space
    assert remote.metadata == local.metadata
    observation, info = remote.reset(seed=9, options={"layout": 4})
    expected, _ = local.reset(seed=9, options={"layout": 4})
    far = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0])
    for step in range(8):
        assert np.array_equal(observation["image"], expected["image"])
        assert np.array_equal(observation["state"], expected["state"])
        action = info.pop("expert_action") if step < 6 else far
        if step < 6:
            assert np.array_equal(action, local.world.expert_action().astype(np.float32))
        observation, *result, info = remote.step(action)
        expected, *expected_result, expected_info = local.step(action)
        assert result == expected_result
        assert {**info, "expert_action": None} == {**expected_info, "expert_action": None}
    assert info["action_followed"] is False
    remote.close()
    local.close()


def test_an_episode_ends_at_the_horizon_and_refuses_more(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    remote.reset(seed=0)
    ends = [remote.step(STILL)[2:4] for _ in range(60)]
    assert ends == [(False, False)] * 59 + [(False, True)]
    words = "step 61: expected at most 60; reset begins a new episode"
    with pytest.raises(RemoteRefused, match=words):
        remote.step(STILL)
    remote.reset(seed=0)
    remote.close()


def test_images_are_writable(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=8, image_width=8)
    for observation in (remote.reset(seed=0)[0], remote.step(STILL)[0]):
        rendered = remote.render()
        observation["image"] += 1
        observation["state"] += 1
        assert rendered is not None and not np.array_equal(rendered, observation["image"])
        rendered[:] = 0
        again = remote.render()
        assert again is not None and again.any()
    remote.close()


def test_what_is_wrong_is_said(endpoint: str) -> None:
    with pytest.raises(RemoteRefused, match=r"expected one of the tasks .* got fold_towel"):
        rever_env.RemoteEnv(endpoint, "fold_towel")
    remote = rever_env.RemoteEnv(endpoint)
    with pytest.raises(RemoteRefused, match="expected Reset first"):
        remote.step(STILL)
    with pytest.raises(ValueError, match="expected only 'layout'"):
        remote.reset(options={"configuraton": 4})
    for layout in (-1, 3.0, True, 1 << 32):
        with pytest.raises(ValueError, match="expected a whole number from 0 to 4294967295, got"):
            remote.reset(options={"layout": layout})
    with pytest.raises(ValueError, match="seed: expected a whole number from 0 to 90071992547409"):
        remote.reset(seed=1 << 53)
    with pytest.raises(RemoteRefused, match="layout 999: expected"):
        remote.reset(options={"layout": 999})
    numpys: Any = np.int64(3)
    remote.reset(seed=numpys, options={"layout": np.int64(3)})
    remote.close()
    remote.close()
    for act in (remote.reset, lambda: remote.step(STILL)):
        with pytest.raises(ClosedEnvironmentError, match="close"):
            act()


@pytest.mark.parametrize(
    "written",
    ["http://127.0.0.1:7447", "tcp/127.0.0.1", "127.0.0.1", "tcp/127.0.0.1:99999", "tcp/:1", ""],
)
def test_endpoints_are_checked_at_once(written: str) -> None:
    with pytest.raises(ValueError, match=r"endpoint '.*': expected tcp/HOST:PORT or HOST:PORT"):
        rever_env.RemoteEnv(written)


def test_an_endpoint_needs_no_protocol(endpoint: str) -> None:
    rever_env.RemoteEnv(endpoint.removeprefix("tcp/"), image_height=0, image_width=0).close()


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("tcp/{free}", r"cannot connect to .*: connection refused; is `python -m rever_env serve"),
        ("tcp/host.invalid:7447", "host host.invalid: "),
        ("fleet", r'no environment server found at tcp/\S+ within 5 s \(fleet "other"\)'),
        ("server", 'no environment server with id "other" found at tcp/'),
    ],
)
def test_who_is_not_there_is_told_within_seconds(endpoint: str, where: str, words: str) -> None:
    begun = time.monotonic()
    with pytest.raises(RemoteFault, match=words) as fault:
        if where.startswith("tcp/"):
            rever_env.RemoteEnv(where.format(free=free_endpoint().removeprefix("tcp/")))
        else:
            rever_env.RemoteEnv(endpoint, **{where: "other"})  # type: ignore[arg-type]
    assert time.monotonic() - begun < 15.0
    assert ".rs" not in str(fault.value)


def stopped_reply(process: "subprocess.Popen[str]", remote: Any, data: bytes) -> None:
    """Sends a step to a stopped server, and a reply to it in the server's place."""
    session = remote.session
    pause(process)
    try:
        remote.send_step(STILL)
        session._network.zenoh.put(reply_key(remote), data)
        remote.receive_step()
    finally:
        os.kill(process.pid, signal.SIGCONT)


def reply_key(remote: Any) -> str:
    """The key of the session's replies."""
    return str(remote.session._publisher.key_expr).removesuffix("request") + "reply"


def test_a_reply_that_cannot_be_understood_is_a_fault_and_no_reward() -> None:
    with served() as (endpoint, process):
        remote = rever_env.RemoteEnv(endpoint, image_height=16, image_width=16)
        for number, words in ((0, "reply cannot be read"), (4, "16 x 16 pixels as before")):
            remote.reset(seed=0)
            data = protocol.REPLY.encode(stepped(number)) if number else b"\xc1"
            with pytest.raises(RemoteFault, match=words):
                stopped_reply(process, remote, data)
        remote.reset(seed=0)
        remote.step(STILL)
        remote.close()


def test_a_reply_that_precedes_its_request_is_a_fault_and_no_reward(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=16, image_width=16)
    remote.reset(seed=0)
    remote.session._network.zenoh.put(reply_key(remote), protocol.REPLY.encode(stepped(2)))
    with pytest.raises(RemoteFault, match="sent reply 2 before its request"):
        remote.step(STILL)
    remote.reset(seed=0)
    remote.step(STILL)
    remote.close()


def stepped(number: int) -> protocol.Stepped:
    """A reply whose image is of another size."""
    transition = protocol.Transition(
        protocol.Observation(protocol.Image(32, 32, b""), (0.0,) * 8, "", None),
        protocol.Statistics(*[False] * 9),
        0.0,
        False,
        False,
    )
    return protocol.Stepped(number, transition, (), 0)


def test_a_session_that_the_server_ended_says_why_and_reset_opens_another(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, SPOON, image_height=0, image_width=0)
    remote.reset(seed=1)
    remote.session._network._declared.pop().undeclare()  # the holder's token
    ends_at = time.monotonic() + 30.0
    with pytest.raises(RemoteFault, match="ended: its client has been gone for 10 s"):
        while time.monotonic() < ends_at:
            remote.session.ask(lambda sequence: protocol.Save(sequence, 0))
    with pytest.raises(RemoteFault, match="the session is lost; reset opens a new one"):
        remote.step(STILL)
    remote.reset(seed=1)
    remote.step(STILL)
    remote.close()


def test_a_task_may_be_named_with_its_variant(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, f"{SPOON}/distractors", image_height=0, image_width=0)
    assert (remote.session.task.task, remote.session.task.variant) == (SPOON, "distractors")
    remote.reset(seed=0)
    remote.close()
    with pytest.raises(RemoteRefused, match=f"{SPOON}/distractors, .* got {SPOON}/upside-down"):
        rever_env.RemoteEnv(endpoint, SPOON, "upside-down")


def test_no_step_follows_one_whose_reply_was_not_taken(endpoint: str) -> None:
    remote = rever_env.RemoteEnv(endpoint, image_height=16, image_width=16)
    first, _ = remote.reset(seed=0)
    remote.send_step(STILL)  # and interrupted, by a user for instance
    with pytest.raises(RemoteFault, match="expected Reset after a request whose reply was not"):
        remote.step(STILL)
    assert np.array_equal(remote.reset(seed=0)[0]["image"], first["image"])
    remote.step(STILL)
    remote.close()
