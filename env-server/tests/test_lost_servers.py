"""Servers that are killed, paused or started again, and processes that fork."""

import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest
from conftest import end, free_endpoint, pause, serve, served

import rever_env
from rever_env import RemoteFault

STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
SMALL: dict[str, Any] = {"image_height": 8, "image_width": 8}


def test_a_killed_server_is_named_and_found_again_by_reset() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint)
    remote = rever_env.RemoteEnv(endpoint, "widowx_stack_cube", **SMALL)
    first, _ = remote.reset(seed=0)
    server = remote.session.server
    end(process)
    begun = time.monotonic()
    with pytest.raises(RemoteFault, match=f"server {server} at {endpoint} is gone"):
        remote.step(STILL)
    assert time.monotonic() - begun < 10.0
    with pytest.raises(RemoteFault, match="the session is lost; reset opens a new one"):
        remote.step(STILL)
    with pytest.raises(RemoteFault, match="connection refused; is `python -m rever_env serve"):
        remote.reset(seed=0)
    process = serve(endpoint)
    try:
        again, _ = remote.reset(seed=0)
        assert np.array_equal(again["image"], first["image"])
        assert remote.session.server != server
        remote.step(STILL)
        remote.close()
    finally:
        end(process)


def test_reset_waits_for_a_server_as_long_as_it_is_told() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint)
    remote = rever_env.RemoteEnv(endpoint, **SMALL, wait_secs=60.0)
    end(process)
    restarted: list[Any] = []
    thread = threading.Thread(target=lambda: restarted.append(serve(endpoint)))
    thread.start()
    try:
        with pytest.raises(RemoteFault, match="is gone"):
            remote.reset(seed=0)
        remote.reset(seed=0)
        remote.close()
    finally:
        thread.join()
        end(restarted[0])


def test_a_server_with_another_task_does_not_take_a_lost_ones_place() -> None:
    endpoint = free_endpoint()
    process = serve(endpoint)
    remote = rever_env.RemoteEnv(endpoint, **SMALL)
    end(process)
    with pytest.raises(RemoteFault, match="is gone"):
        remote.reset(seed=0)
    process = serve(endpoint, "--gymnasium", "CartPole-v1")
    try:
        with pytest.raises(ValueError, match="tasks CartPole-v1, got widowx_spoon_on_towel"):
            remote.reset(seed=0)
        remote.close()
    finally:
        end(process)


def test_a_paused_server_is_waited_for() -> None:
    """Longer than requests are sent again after, and the server looked for."""
    with served() as (endpoint, process):
        remote = rever_env.RemoteEnv(endpoint, **SMALL)
        remote.reset(seed=0)
        pause(process)
        timer = threading.Timer(4.0, os.kill, (process.pid, signal.SIGCONT))
        timer.start()
        remote.step(STILL)
        timer.join()
        remote.close()


def test_a_server_that_does_not_answer_in_time_is_told_apart_from_one_that_is_gone() -> None:
    with served() as (endpoint, process):
        remote = rever_env.RemoteEnv(endpoint, **SMALL, reply_secs=2.0)
        remote.reset(seed=0)
        pause(process)
        begun = time.monotonic()
        with pytest.raises(RemoteFault, match=rf"at {endpoint} did not answer for 2 s"):
            remote.step(STILL)
        assert 2.0 <= time.monotonic() - begun < 10.0
        os.kill(process.pid, signal.SIGCONT)
        remote.reset(seed=0)
        remote.step(STILL)
        remote.close()


def test_a_stopped_server_does_not_hold_up_close() -> None:
    with served() as (endpoint, process):
        remote = rever_env.RemoteEnv(endpoint, **SMALL)
        pause(process)
        begun = time.monotonic()
        remote.close()
        assert time.monotonic() - begun < 10.0


ROUTER = """
import json, sys, time, zenoh
scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
configuration = {"mode": "router", "listen": {"endpoints": [sys.argv[1]]}, "scouting": scouting}
network = zenoh.open(zenoh.Config.from_json5(json.dumps(configuration)))
print("ready", flush=True)
sys.stdin.read()
"""


def route(endpoint: str) -> "subprocess.Popen[str]":
    """A router that is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", ROUTER, endpoint],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def test_a_router_that_comes_back_costs_no_episode_and_one_that_does_not_is_named() -> None:
    endpoint = free_endpoint()
    routers = [route(endpoint)]
    server = subprocess.Popen(
        [sys.executable, "-m", "rever_env", "serve", "--connect", endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert server.stdout is not None and server.stdout.readline().startswith("ready")
        remote = rever_env.RemoteEnv(endpoint, **SMALL, wait_secs=30.0)
        local = rever_env.BridgeEnv(remote.session.task.task, **SMALL)
        for environment in (remote, local):
            environment.reset(seed=0)
        move = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
        end(routers[0])
        timer = threading.Timer(1.0, lambda: routers.append(route(endpoint)))
        timer.start()
        for _ in range(2):  # once each, however often it was sent
            assert np.array_equal(remote.step(move)[0]["state"], local.step(move)[0]["state"])
        timer.join()
        end(routers[1])
        with pytest.raises(RemoteFault, match="cannot be reached: the router is gone"):
            remote.step(move)
        remote.close()
        local.close()
    finally:
        end(server)
        for process in routers:
            end(process)


FORKING = """
import gymnasium, os, sys, rever_env
environment = rever_env.RemoteEnv(sys.argv[1], image_height=8, image_width=8)
environment.reset(seed=0)
child = os.fork()
if child == 0:
    for act in (environment.reset, lambda: rever_env.RemoteEnv(sys.argv[1]).reset()):
        try:
            act()
        except rever_env.RemoteFault as fault:
            print("child:", fault)
    environment.close()
    del environment
    sys.exit(7)
print("child ended:", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
environment.step(environment.action_space.sample())  # the child closed nothing of ours
environment.close()
vector = gymnasium.make_vec(
    "rever/Remote-v1", 2, "async", {"context": "fork"}, connect=sys.argv[1], task=sys.argv[2]
)
try:
    vector.reset()
except rever_env.RemoteFault as fault:
    print("parent:", fault)
"""


def test_forked_environments_say_so_instead_of_hanging(endpoint: str) -> None:
    said = subprocess.run(
        [sys.executable, "-u", "-c", FORKING, endpoint, "widowx_stack_cube"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    words = "do not work in a forked process"
    lines = said.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == ["child"] * 2 + ["child ended", "parent"]
    assert all(words in line and "'forkserver'" in line for line in lines if "ended" not in line)
    assert "child ended: 7" in lines, said.stderr
