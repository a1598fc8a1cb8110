"""OpenGL contexts: in any thread, in a forked process, and whatever the environment says."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import TASKS

from rever_env import opengl
from rever_env.fault import RendererUnavailable
from rever_env.world import World

PACKAGE_ROOT = Path(__file__).resolve().parent.parent
VENDOR_FILES = "__EGL_VENDOR_LIBRARY_FILENAMES"
ONE_IMAGE = """
import hashlib
import gymnasium
environment = gymnasium.make("rever_env:rever/StackCube-v1")
image = environment.reset(seed=0)[0]["image"]
print(hashlib.sha256(image.tobytes()).hexdigest(), flush=True)
"""


def run(program: str, **variables: str) -> "subprocess.CompletedProcess[str]":
    """The program in a fresh Python, without what this process knows of OpenGL."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM", "LIBGL_ALWAYS_SOFTWARE")
    }
    return subprocess.run(
        [sys.executable, "-c", program],
        env=kept | variables | {"PYTHONPATH": str(PACKAGE_ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture(scope="module")
def expected() -> str:
    """The digest of the image of ONE_IMAGE."""
    done = run(ONE_IMAGE)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def images(world: World) -> bytes:
    """What the expert sees in its first steps."""
    seen = [world.reset(layout=3, seed=0).image]
    for _ in range(5):
        seen.append(world.step(world.expert_action()).observation.image)
    return np.stack(seen).tobytes()


def test_worlds_give_the_same_images_in_other_threads() -> None:
    worlds = [World(task, 48, 64) for task in TASKS.values()]
    in_this_thread = [images(world) for world in worlds]
    with ThreadPoolExecutor(len(worlds)) as threads:
        assert list(threads.map(images, worlds)) == in_this_thread
        made_there = list(threads.map(lambda task: World(task, 48, 64), TASKS.values()))
        list(threads.map(World.close, worlds))
    assert [images(world) for world in made_there] == in_this_thread
    for world in made_there:
        world.close()


def test_one_world_in_two_threads_at_once_is_refused() -> None:
    with World(TASKS["widowx_stack_cube"], 16, 16) as world, ThreadPoolExecutor(1) as thread:
        expected = world.reset(layout=0, seed=0).image
        with world.camera._context.current():
            other = thread.submit(world.reset, layout=0, seed=0)
            with pytest.raises(RendererUnavailable, match="current in another thread"):
                other.result(timeout=10)
        np.testing.assert_array_equal(world.reset(layout=0, seed=0).image, expected)


def test_another_librarys_context_stays_current() -> None:
    egl = opengl._library()
    other = opengl.Context()
    with World(TASKS["widowx_stack_cube"], 16, 16) as world:
        with other.current():
            world.reset(layout=0, seed=0)
            assert egl.eglGetCurrentContext() == other._handle
        assert egl.eglGetCurrentContext() is None
        with opengl.preserved_context():
            egl.eglMakeCurrent(*other._display.nothing[:3], other._handle)
        assert egl.eglGetCurrentContext() is None
    other.free()


@pytest.mark.parametrize(
    "variables",
    [
        {"DISPLAY": ":99"},
        {"DISPLAY": ":99", "MUJOCO_GL": "glfw", "PYOPENGL_PLATFORM": "osmesa"},
        {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "1", "CUDA_VISIBLE_DEVICES": "GPU-0a1b"},
        {"MUJOCO_GL": "disable", "LIBGL_ALWAYS_SOFTWARE": "0"},
    ],
    ids=lambda variables: " ".join(variables),
)
def test_images_do_not_depend_on_the_environment(variables: dict[str, str], expected: str) -> None:
    # MuJoCo reads its variables when it is imported: before rever_env here.
    done = run("import mujoco\n" + ONE_IMAGE, **variables)
    assert (done.stdout, done.returncode) == (expected, 0), done.stderr


def test_a_program_that_closes_nothing_ends_quietly(expected: str) -> None:
    # What is finalised at the end was registered before the first context: it runs after it.
    begin = "import tempfile\nfolder = tempfile.TemporaryDirectory()\n"
    done = run(begin + ONE_IMAGE)
    assert (done.stdout, done.stderr, done.returncode) == (expected, "", 0)
    failed = run(begin + ONE_IMAGE + "raise SystemExit('the error of the user')\n")
    assert (failed.stderr, failed.returncode) == ("the error of the user\n", 1)


def test_a_forked_process_draws_the_same_images(expected: str) -> None:
    child = (
        "import os\n"
        "if os.fork() == 0:\n"
        "    for one in (environment, gymnasium.make('rever/StackCube-v1')):\n"
        "        image = one.reset(seed=0)[0]['image']\n"
        "        print(hashlib.sha256(image.tobytes()).hexdigest(), flush=True)\n"
        "    os._exit(0)\n"
        "assert os.waitpid(-1, 0)[1] == 0\n"
    )
    done = run(ONE_IMAGE + child)
    assert (done.stdout, done.stderr) == (3 * expected, "")


def test_the_fault_names_the_variable_that_hides_the_renderer() -> None:
    done = run(ONE_IMAGE, **{VENDOR_FILES: "/nowhere/10_nvidia.json"})
    reason = "renderer for 128 x 128 images: expected an offscreen OpenGL context, got none of 0"
    assert reason in done.stderr and f"{VENDOR_FILES}=/nowhere/10_nvidia.json" in done.stderr


def test_a_process_of_rever_env_ignores_such_a_variable(expected: str, tmp_path: Path) -> None:
    nvidia, mesa = tmp_path / "10_nvidia.json", tmp_path / "50_mesa.json"
    for file, library in ((nvidia, "libEGL_nvidia.so.0"), (mesa, "libEGL_mesa.so.0")):
        icd = {"file_format_version": "1.0.0", "ICD": {"library_path": library}}
        file.write_text(json.dumps(icd))
    isolate = "from rever_env import opengl\nprint(opengl.isolate_process())\n"
    ignored = run(isolate + ONE_IMAGE, **{VENDOR_FILES: str(nvidia), "EGL_PLATFORM": "x11"})
    assert f"ignored {VENDOR_FILES}={nvidia}" in ignored.stdout
    assert ignored.stdout.endswith(expected)
    kept = run(isolate + ONE_IMAGE, **{VENDOR_FILES: f"{nvidia}:{mesa}"})
    assert kept.stdout == "[]\n" + expected
