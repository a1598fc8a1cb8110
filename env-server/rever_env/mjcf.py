"""A task's scene in MuJoCo's XML, with its includes and the task's changes applied."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco

from rever_env.tasks import MjcfChange, Task

Element = ElementTree.Element


def compile(task: Task) -> mujoco.MjModel:
    """The scene as a compiled MuJoCo model."""
    text = ElementTree.tostring(scene(task), encoding="unicode")
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ValueError(f"{task.scene.name} of task {task.id}: {error}") from error


def scene(task: Task) -> Element:
    """The scene as one XML tree."""
    root = _included(task.scene)
    for change in task.mjcf:
        found = elements(root, change)
        if len(found) != 1:
            raise ValueError(
                f"{task.scene.name} of task {task.id}: expected one {change.element} named "
                f"{change.name}, got {len(found)}"
            )
        found[0].set(change.attribute, change.value)
    return root


def elements(root: Element, change: MjcfChange) -> list[Element]:
    """The elements that a change names; a nameless one (inertial) goes by its parent's name."""
    parents = {child: parent for parent in root.iter() for child in parent}

    def name(element: Element) -> str | None:
        named = element if "name" in element.attrib else parents.get(element, element)
        return named.get("name")

    return [element for element in root.iter(change.element) if name(element) == change.name]


def _included(path: Path) -> Element:
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        children: list[Element] = []
        for child in parent:
            is_include = child.tag == "include"
            children += _included(path.parent / child.attrib["file"]) if is_include else [child]
        parent[:] = children
    return root
