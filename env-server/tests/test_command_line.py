"""The command line says in one line what is wrong."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest


def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """The package as a program."""
    return subprocess.run(
        [sys.executable, "-m", "rever_env", *arguments], capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (
            "demonstrate --episodes 1 --out /proc/x",
            1,
            "error: cannot use /proc/x: No such file or directory",
        ),
        (
            "trace --actions /nowhere/actions.txt",
            1,
            "error: cannot use /nowhere/actions.txt: No such file or directory",
        ),
        ("demonstrate --episodes 1 --out x --tasks cup", 1, "error: task cup: expected one of"),
        (
            "serve --listen tcp/127.0.0.1:9 --id-file /nowhere/id",
            2,
            "error: --id-file /nowhere/id: expected an existing folder, got /nowhere",
        ),
        (
            "serve --listen tcp/127.0.0.1:9 --control-hz 5",
            2,
            "error: --control-hz has no effect without --robosuite and one of robosuite's own",
        ),
    ],
)
def test_an_error_is_one_line(arguments: str, status: int, words: str) -> None:
    done = run(*arguments.split())
    assert done.returncode == status
    assert done.stderr.startswith(words), done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("demonstrate --episodes 0 --out x", "--episodes: expected a positive whole number, got 0"),
        ("expert --processes -1", "--processes: expected a positive whole number, got -1"),
        ("serve --arguments notjson", "--arguments: expected a JSON object, got notjson"),
        ("serve --listen 127.0.0.1", "endpoint '127.0.0.1': expected tcp/HOST:PORT or HOST:PORT"),
        ("serve --listen tcp/127.0.0.1:99999", "expected tcp/HOST:PORT or HOST:PORT"),
        ("serve --listen tcp/127.0.0.1:9 --fleet ../x", "invalid fleet name"),
        ("serve --listen tcp/127.0.0.1:9 --sessions 0", "--sessions: expected 1 to 256, got 0"),
        ("", "the following arguments are required: COMMAND"),
    ],
)
def test_wrong_usage_exits_with_2(arguments: str, words: str) -> None:
    done = run(*arguments.split())
    assert done.returncode == 2
    assert words in done.stderr


def test_a_folder_that_is_a_file_is_said(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    done = run("demonstrate", "--episodes", "1", "--out", str(tmp_path / "taken"))
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: cannot use {tmp_path}/taken/"), done.stderr
    assert "Not a directory" in done.stderr


def test_a_port_that_is_in_use_is_named_without_the_paths_of_a_build() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        done = run("serve", "--listen", endpoint)
    assert done.returncode == 1
    error = done.stderr.splitlines()[-1]
    assert error.startswith("error: cannot open the network: ")
    assert endpoint in error and "Address already in use" in error
    assert ".rs" not in done.stderr
