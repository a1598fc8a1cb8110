"""The two packages that hold rever_env, this one and the wheel of the program, agree."""

import sys
from pathlib import Path
from typing import Any

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = (REPOSITORY / "env-server", REPOSITORY / "agent/cli")


def project(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
    found: dict[str, Any] = table["project"]
    return found


@pytest.mark.parametrize("key", ["dependencies", "license", "requires-python", "version"])
def test_the_wheel_of_the_program_requires_what_the_package_requires(key: str) -> None:
    package, wheel = map(project, FOLDERS)
    assert wheel[key] == package[key]


def test_the_wheel_of_the_program_has_the_extras_of_the_package() -> None:
    package, wheel = (project(folder)["optional-dependencies"] for folder in FOLDERS)
    del package["development"]
    extras = {
        name: [one.replace("rever_env[", "rever[") for one in requirements]
        for name, requirements in package.items()
    }
    assert wheel == extras


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_files_that_the_metadata_name_exist(folder: Path) -> None:
    named = project(folder)
    assert (folder / named["readme"]).is_file()
    for name in named["license-files"]:
        assert "Apache License" in (folder / name).read_text(encoding="utf-8")


def test_the_package_is_typed() -> None:
    assert (REPOSITORY / "env-server/rever_env/py.typed").is_file()
