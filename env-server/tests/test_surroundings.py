"""Servers start and draw the same in surroundings that other programs set, or say why not."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import TASKS, free_endpoint

from rever_env.remote import RemoteEnv
from rever_env.remote_session import RemoteRefused
from rever_env.world import World

READY_SECS = 120.0
HOSTILE = {
    "CUDA_VISIBLE_DEVICES": "GPU-8f2a,GPU-1c3d",
    "DISPLAY": ":99",
    "EGL_PLATFORM": "x11",
    "GALLIUM_DRIVER": "zink",
    "LIBGL_ALWAYS_SOFTWARE": "0",
    "MUJOCO_EGL_DEVICE_ID": "1",
    "MUJOCO_GL": "osmesa",
    "PYOPENGL_PLATFORM": "osmesa",
    "SDL_VIDEODRIVER": "x11",
    "__EGL_VENDOR_LIBRARY_FILENAMES": "/usr/share/glvnd/egl_vendor.d/10_nvidia.json",
}


@contextmanager
def served(variables: dict[str, str], *arguments: str) -> Iterator[tuple[str, list[str]]]:
    """The endpoint of a server, and the lines that it printed until it was ready."""
    endpoint = free_endpoint()
    process = subprocess.Popen(
        [sys.executable, "-m", "rever_env", "serve", "--listen", endpoint, *arguments],
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    lines: list[str] = []
    try:
        for line in process.stdout:  # ends with the process
            lines.append(line)
            if line.startswith("ready "):
                break
        assert lines and lines[-1].startswith("ready "), lines
        yield endpoint, lines
    finally:
        process.terminate()
        process.wait(timeout=READY_SECS)
        process.stdout.close()


@pytest.mark.parametrize(
    "variables",
    [HOSTILE, {"CUDA_VISIBLE_DEVICES": ""}, {"CUDA_VISIBLE_DEVICES": "1"}],
    ids=["hostile", "no cards", "second card"],
)
def test_a_server_draws_our_tasks_in_any_surroundings(variables: dict[str, str]) -> None:
    task = TASKS["widowx_stack_cube"]
    with World(task, 48, 64) as world:
        expected = world.reset(layout=2, seed=0).image
    with served(variables) as (endpoint, lines):
        remote = RemoteEnv(endpoint, task=task.name, image_height=48, image_width=64)
        observation, _ = remote.reset(seed=0, options={"layout": 2})
        np.testing.assert_array_equal(observation["image"], expected)
        remote.close()
    assert any("ignored __EGL" in line for line in lines) == (variables is HOSTILE)


@pytest.mark.parametrize(
    ("package", "arguments"),
    [
        ("robosuite", ("--robosuite", "widowx_stack_cube")),
        ("robosuite", ("--robosuite", "Lift")),
        ("pygame", ("--gymnasium", "CartPole-v1")),
        ("imageio", ("--gymnasium", "Hopper-v5")),
    ],
)
def test_other_simulators_draw_in_any_surroundings(
    package: str, arguments: tuple[str, ...]
) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    with served(HOSTILE, *arguments) as (endpoint, _):
        remote = RemoteEnv(endpoint, image_height=48, image_width=64)
        observation, _ = remote.reset(seed=0)
        assert observation["image"].std() > 1.0
        remote.close()


def test_a_server_that_cannot_draw_says_so_before_it_is_ready(tmp_path: Path) -> None:
    # Without vendors EGL knows no device, as on a machine without Mesa.
    hidden = f"{tmp_path}/50_mesa.json"
    with open(hidden, "w", encoding="utf-8") as file:
        file.write('{"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_mesa_no.so"}}')
    with served({"__EGL_VENDOR_LIBRARY_FILENAMES": hidden}) as (endpoint, lines):
        warning = "cannot render images; sessions with images are refused: none of 0 EGL"
        assert any(warning in line and hidden in line for line in lines), lines
        with pytest.raises(RemoteRefused, match="expected an offscreen OpenGL context"):
            RemoteEnv(endpoint, image_height=48, image_width=64).reset(seed=0)
        remote = RemoteEnv(endpoint, image_height=0, image_width=0)
        assert remote.reset(seed=0)[0]["state"].shape == (8,)
        remote.close()
