"""The examples of the READMEs run as they are written."""

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rever_env

ENV_SERVER = Path(__file__).resolve().parent.parent
READMES = [ENV_SERVER / "README.md", ENV_SERVER.parent / "README.md"]
EXAMPLES = [
    pytest.param(code, id=f"{'the-root' if readme.parent != ENV_SERVER else 'env-server'}-{index}")
    for readme in READMES
    if readme.is_file()  # an installed package has none
    for index, code in enumerate(
        re.findall(r"```python\n(.*?)```", readme.read_text("utf-8"), re.S)
    )
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_an_example_runs(code: str, endpoint: str) -> None:
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(code.replace("tcp/127.0.0.1:7447", endpoint), names)
    if "info" in names:
        assert names["info"]["is_success"] in (True, False)


def test_the_example_moves_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which, at random, takes a space whose bounds mean something."""
    positions = []
    step = rever_env.BridgeEnv.step

    def observed(self: Any, action: Any) -> Any:
        result = step(self, action)
        positions.append(result[0]["state"][:3])
        return result

    monkeypatch.setattr(rever_env.BridgeEnv, "step", observed)
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(EXAMPLES[0].values[0], names)  # type: ignore[arg-type]
    assert names["truncated"]
    path = np.linalg.norm(np.diff(np.array(positions), axis=0), axis=1)
    # Metres; 40 episodes of random actions moved the gripper by 0.25 to 1.9. An arm whose commanded
    # pose is out of reach at once holds still.
    assert len(positions) == 60 and path.sum() > 0.1
