"""What bench prints and refuses; how fast anything is, no test says."""

import json
import subprocess
import sys
from pathlib import Path


def bench(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rever_env", "bench", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_step_is_timed_beside_what_it_is_made_of(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    tasks = ("widowx_spoon_on_towel", "widowx_stack_cube")
    done = bench("--tasks", *tasks, "--steps", "70", "--side", "32", "--json", str(file))
    assert done.returncode == 0, done.stderr
    figures = json.loads(file.read_text(encoding="utf-8"))
    assert [row["what"] for row in figures["rows"]] == [
        tasks[0],
        f"{tasks[0]}, bare",
        tasks[1],
        f"{tasks[1]}, bare",
    ]
    # 70 steps are more than an episode has.
    assert all(row["steps"] == 70 and row["p50_ms"] > 0 for row in figures["rows"])
    assert f"ratio_bare {figures['ratio_bare']:.2f}" in done.stdout
    assert "ratio_robosuite" not in figures
    assert f"commit {figures['commit']}" in done.stdout


def test_what_cannot_be_timed_is_refused_in_words() -> None:
    few = bench("--steps", "3")
    assert few.returncode == 2
    assert few.stderr == "error: expected at least 10 steps and 1 pixel, got 3 and 224\n"
    # The test environment has no robosuite, as most users' have none.
    other = bench("--robosuite")
    assert other.returncode == 2
    assert other.stderr.startswith("error: --robosuite needs robosuite 1.5.2 (")
