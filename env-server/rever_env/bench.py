"""The bench subcommand: time of a control step with its image, compared with bare MuJoCo calls.

Blocks of steps alternate between the sides, so that a change of the machine's speed affects all.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import mjcf
from rever_env.tasks import Task
from rever_env.world import World

_BLOCK = 10  # consecutive steps of one kind, after one that warms the caches
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_CONTROL_HZ = 5
_ROBOSUITE = "robosuite's Stack, Panda"
_STACK = "widowx_stack_cube"  # the Bridge task that is most like robosuite's Stack

Block = Callable[[], list[float]]  # runs _BLOCK + 1 steps, returns the seconds of each


@dataclass(frozen=True)
class Row:
    """Times of one kind of step."""

    what: str
    steps: int
    p50_ms: float
    p95_ms: float


def bench(
    tasks: list[Task], side: int, steps: int, *, with_robosuite: bool, file: Path | None
) -> int:
    """Prints a table and the ratios of medians, and writes them to the file; returns the status."""
    if steps < _BLOCK or side < 1:
        print(
            f"error: expected at least {_BLOCK} steps and 1 pixel, got {steps} and {side}",
            file=sys.stderr,
        )
        return 2
    try:
        other = _robosuite(side) if with_robosuite else None
    except ImportError as error:
        print(f"error: --robosuite needs robosuite 1.5.2 ({error})", file=sys.stderr)
        return 2
    rows = measure(tasks, side, steps, other)
    ratios = _ratios(rows)
    print(f"{'control step':56} {'steps':>6} {'p50 ms':>8} {'p95 ms':>8}")
    for row in rows:
        print(f"{row.what:56} {row.steps:6} {row.p50_ms:8.2f} {row.p95_ms:8.2f}")
    print(f"{side} x {side} pixels, {_CONTROL_HZ} Hz control")
    for name, ratio in ratios.items():
        print(f"{name} {ratio:.2f}")
    print(f"commit {_commit()}")
    if file:
        figures = {
            "side": side,
            "rows": [asdict(row) for row in rows],
            **ratios,
            "commit": _commit(),
        }
        file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


def _commit() -> str:
    """The commit of the checkout, with -dirty for uncommitted changes."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10"]
    folder = Path(__file__).resolve().parent
    try:
        told = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return told.stdout.strip()


def measure(tasks: list[Task], side: int, steps: int, other: Block | None = None) -> list[Row]:
    """Times of each task: a step of World, the same as bare MuJoCo calls, the other simulator."""
    rows = []
    for task in tasks:
        with World(task, side, side) as world:
            blocks = _Blocks(world, side)
            ours: list[float] = []
            bare: list[float] = []
            others: list[float] = []
            for index in range(1 + steps // _BLOCK):
                seconds = (blocks.world(), blocks.bare(), other() if other else [])
                if index > 0:  # shaders compile in the first block
                    for times, more in zip((ours, bare, others), seconds, strict=True):
                        times.extend(more[1:])
            blocks.close()
        rows += [_row(str(task.id), ours), _row(f"{task.id}, bare", bare)]
        if other:
            rows.append(_row(f"{task.id}, {_ROBOSUITE}", others))
    return rows


class _Blocks:
    """Steps of World with the expert's actions, and the same states with bare MuJoCo calls."""

    def __init__(self, world: World, side: int) -> None:
        self._world = world
        self._substeps = world.task.settings.substeps
        self._camera = world.task.settings.camera
        # A second model, because the world's camera hides shapes of the first.
        self._model = mjcf.compile(world.task)
        self._spare = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, side, side)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = 0
        self._seed = 0
        self._states: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def world(self) -> list[float]:
        """Seconds of control steps of World."""
        world = self._world
        self._states.clear()
        seconds = []
        for _ in range(_BLOCK + 1):
            if world.memory is None or world.steps >= world.task.steps_max:
                world.reset(layout=None, seed=self._seed)
                self._seed += 1
            action = world.expert_action()
            state = np.empty(mujoco.mj_stateSize(world.model, _STATE))
            mujoco.mj_getState(world.model, world.data, state, _STATE)
            begun = time.perf_counter()
            world.step(action)
            seconds.append(time.perf_counter() - begun)
            self._states.append((state, world.data.ctrl.copy()))
        return seconds

    def bare(self) -> list[float]:
        """Seconds of the same physics and the same image with MuJoCo's own calls."""
        model, data = self._model, self._spare
        seconds = []
        for state, control in self._states:
            mujoco.mj_setState(model, data, state, _STATE)
            data.ctrl[:] = control
            begun = time.perf_counter()
            mujoco.mj_step(model, data, self._substeps)
            self._renderer.update_scene(data, self._camera)
            self._renderer.render()
            seconds.append(time.perf_counter() - begun)
        return seconds

    def close(self) -> None:
        self._renderer.close()


def _robosuite(side: int) -> Block:
    """Steps of robosuite's Stack with a Panda, one camera and small random actions."""
    from rever_env.robosuite_tasks import load_robosuite

    environment: Any = load_robosuite().make(
        "Stack",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_heights=side,
        camera_widths=side,
        control_freq=_CONTROL_HZ,
        ignore_done=True,
    )
    environment.reset()
    random = np.random.default_rng(0)
    low, high = environment.action_spec

    def block() -> list[float]:
        # robosuite renders into the current context, and MuJoCo's renderer has changed that.
        environment.sim._render_context_offscreen.gl_ctx.make_current()
        seconds = []
        for _ in range(_BLOCK + 1):
            action = 0.2 * random.uniform(low, high)
            begun = time.perf_counter()
            environment.step(action)
            seconds.append(time.perf_counter() - begun)
        return seconds

    return block


def _row(what: str, seconds: list[float]) -> Row:
    p50, p95 = (1e3 * float(number) for number in np.percentile(seconds, (50, 95)))
    return Row(what, len(seconds), p50, p95)


def _ratios(rows: list[Row]) -> dict[str, float]:
    """Ratios of median times.

    ratio_bare: bare MuJoCo calls / World, mean over the tasks. ratio_robosuite: robosuite / World.
    ratio_robosuite_stack: robosuite's Stack / the Bridge task that stacks.
    """
    p50_ms = {row.what: row.p50_ms for row in rows}
    tasks = [what for what in p50_ms if "," not in what]
    bare = [p50_ms[f"{task}, bare"] / p50_ms[task] for task in tasks]
    ratios = {"ratio_bare": float(np.mean(bare))}
    theirs = {
        task: p50_ms[f"{task}, {_ROBOSUITE}"] / p50_ms[task]
        for task in tasks
        if f"{task}, {_ROBOSUITE}" in p50_ms
    }
    if theirs:
        ratios["ratio_robosuite"] = float(np.mean(list(theirs.values())))
    if _STACK in theirs:
        ratios["ratio_robosuite_stack"] = theirs[_STACK]
    return ratios
