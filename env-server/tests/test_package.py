"""What the package says of itself: its names, its help, its types and its lowest versions."""

import pydoc
import re
from pathlib import Path

import gymnasium
import pytest

import rever_env

ENV_SERVER = Path(__file__).resolve().parent.parent


def test_every_public_name_is_there_and_described() -> None:
    for name in rever_env.__all__:
        documented = getattr(rever_env, name)
        assert name in dir(rever_env) and documented.__doc__
    for kind in (rever_env.BridgeEnv, rever_env.RemoteEnv, rever_env.RemoteVectorEnv):
        for method in ("reset", "step", "render", "close"):
            assert getattr(kind, method).__doc__, f"{kind.__name__}.{method}"
    with pytest.raises(AttributeError, match="no attribute 'RemoteFaults'"):
        _ = rever_env.RemoteFaults


def test_help_names_every_id_and_has_an_example() -> None:
    shown = pydoc.plain(pydoc.render_doc(rever_env))
    ids = [name for name in gymnasium.registry if name.startswith("rever/")]
    assert len(ids) == 5 and all(name in shown for name in ids)
    assert "gymnasium.make(" in shown and ".step(" in shown
    readme = (ENV_SERVER / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in readme for name in ids)


def test_type_checkers_may_read_the_package() -> None:
    assert (Path(rever_env.__file__).parent / "py.typed").is_file()


def test_the_lowest_versions_are_those_that_are_tested() -> None:
    """requirements-minimum.txt pins the bounds that pyproject.toml states."""
    project = (ENV_SERVER / "pyproject.toml").read_text(encoding="utf-8")
    listed = project[project.index("\ndependencies = [") : project.index("]\n\n[project.optional")]
    bounds = dict(re.findall(r'"([a-z-]+)>=([0-9.]+)', listed))
    pinned = dict(
        re.findall(
            r"^([a-z-]+)==([0-9.]+)",
            (ENV_SERVER / "requirements-minimum.txt").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    )
    assert {"gymnasium", "eclipse-zenoh", "msgpack", "numpy"} <= set(bounds)
    for name, bound in bounds.items():
        assert pinned[name] == bound or pinned[name] == f"{bound}.0", name
