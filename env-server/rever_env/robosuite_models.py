"""Arena, robot and gripper of our scenes as robosuite models.

They are derived from the files in assets/, cut where robosuite joins its parts. Motors replace the
arm's joint drives, because robosuite's controllers command torques.
"""

import copy
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from robosuite.models.arenas import Arena
from robosuite.models.grippers import register_gripper
from robosuite.models.grippers.gripper_model import GripperModel
from robosuite.models.robots.manipulators.manipulator_model import ManipulatorModel
from robosuite.robots import register_robot_class

from rever_env import mjcf, tasks
from rever_env.fault import InvalidReset
from rever_env.tasks import Task

Element = ElementTree.Element
_HAND = "gripper_bar_link"  # the first body of the gripper
_UNSEEN = {"size": "0.002", "group": "4", "rgba": "0 0 0 0"}


def bridge_arena(task: Task) -> Arena:
    """A task's scene with its objects and without the robot."""
    scene = _scene(task)
    robot = _base(scene)
    for change in task.mjcf:
        found = mjcf.elements(scene, change)
        if change.element != "camera" and any(one in robot.iter() for one in found):
            raise InvalidReset(
                f"task {task.id}: robosuite needs the same robot in every task, but this task "
                f"changes its {change.element} {change.name}"
            )
    with _written(_arena(scene)) as path:
        return Arena(path)


def fit_scene(model: Element, robot: ManipulatorModel, task: Task) -> None:
    """Sets poses and settings of robot, camera and lights as in the task's scene."""
    scene = _scene(task)
    base, root = _base(scene), robot.worldbody.find("body")
    root.attrib.update({name: base.attrib[name] for name in ("pos", "quat")})
    camera = {**base.find("camera").attrib}  # type: ignore[union-attr]
    camera.pop("name")
    root.find("camera").attrib.update(camera)
    visual = model.find("visual")
    assert visual is not None, "robosuite's models have one"
    for wanted in (element for some in scene.findall("visual") for element in some):
        if wanted.tag in ("headlight", "map", "quality"):
            visual[:] = [element for element in visual if element.tag != wanted.tag]
            visual.append(wanted)


@register_gripper
class WidowXGripper(GripperModel):  # type: ignore[misc]
    """The WidowX's two fingers; one command, -1 open, +1 closed."""

    def __init__(self, idn: Any = 0) -> None:
        with _written(_gripper(_any_scene())) as path:
            super().__init__(path, idn=idn)

    def format_action(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Commands of the two fingers, (2,), in their range: -1 closed, +1 open."""
        assert len(action) == self.dof
        return np.clip(np.repeat(-np.asarray(action, np.float64), 2), -1.0, 1.0)

    @property
    def init_qpos(self) -> NDArray[np.float64]:
        return np.array(_any_task().robot_joints[6:])

    @property
    def speed(self) -> float:
        return 1.0

    @property
    def dof(self) -> int:
        return 1

    @property
    def _important_geoms(self) -> dict[str, list[str]]:
        left, right = ["left_finger_pad"], ["right_finger_pad"]
        return {
            "left_finger": left,
            "right_finger": right,
            "left_fingerpad": left,
            "right_fingerpad": right,
        }


@register_robot_class("FixedBaseRobot")
class WidowX(ManipulatorModel):  # type: ignore[misc]
    """The WidowX-250S of the Bridge tasks: six joints, torque-controlled."""

    arms = ("right",)

    def __init__(self, idn: Any = 0) -> None:
        with _written(_robot(_any_scene())) as path:
            super().__init__(path, idn=idn)

    @property
    def default_base(self) -> str:
        return "NullMount"

    @property
    def default_gripper(self) -> dict[str, str]:
        return {"right": WidowXGripper.__name__}

    @property
    def default_controller_config(self) -> dict[str, str]:
        return {"right": "osc_pose"}

    @property
    def init_qpos(self) -> NDArray[np.float64]:
        return np.array(_any_task().robot_joints[:6])

    @property
    def base_xpos_offset(self) -> dict[str, Any]:
        return {"table": lambda _length: (0.0, 0.0, 0.0)}

    @property
    def top_offset(self) -> NDArray[np.float64]:
        return np.zeros(3)

    @property
    def _horizontal_radius(self) -> float:
        return 0.1

    @property
    def arm_type(self) -> str:
        return "single"


def _any_task() -> Task:
    return next(iter(tasks.load().values()))


def _any_scene() -> Element:
    """The scene of any task: the robot is the same in all, except for its pose (see fit_scene)."""
    return _scene(_any_task())


def _scene(task: Task) -> Element:
    """A task's scene with the values of its default classes written out in each element."""
    scene = mjcf.scene(task)
    classes: dict[str, dict[str, dict[str, str]]] = {}
    for node in scene.findall("default"):
        _collect(node, {}, classes)
        scene.remove(node)
    for node in scene.findall("worldbody"):
        _apply(node, "main", classes)
    return scene


def _collect(
    node: Element,
    inherited: dict[str, dict[str, str]],
    classes: dict[str, dict[str, dict[str, str]]],
) -> None:
    own = {tag: dict(values) for tag, values in inherited.items()}
    for child in node:
        if child.tag != "default":
            own.setdefault(child.tag, {}).update(child.attrib)
    classes[node.get("class", "main")] = own
    for child in node.findall("default"):
        _collect(child, own, classes)


def _apply(node: Element, of_body: str, classes: dict[str, dict[str, dict[str, str]]]) -> None:
    for child in node:
        kind = child.attrib.pop("class", of_body)
        for name, value in classes[kind].get(child.tag, {}).items():
            child.attrib.setdefault(name, value)
        _apply(child, child.attrib.pop("childclass", of_body), classes)


def _robot(scene: Element) -> Element:
    """The arm from base to wrist, with a motor for each joint."""
    base = _base(scene)
    _without_gripper(base)
    # robosuite's controllers compensate gravity.
    for body in base.iter("body"):
        body.attrib.pop("gravcomp", None)
    for element in base.iter("joint"):
        # robosuite adds damping and friction to joints without these attributes. Its controller
        # does not compensate them: the arm would stop up to 8 % short of the commanded pose.
        element.attrib.update(damping="0", frictionloss="0")
    model = _model("widowx", scene, [base])
    actuator = ElementTree.SubElement(model, "actuator")
    drives = [drive for drive in scene.iter("position") if "finger" not in drive.attrib["joint"]]
    for drive in drives:
        joint, limit = drive.attrib["joint"], drive.attrib["forcerange"]
        ElementTree.SubElement(
            actuator,
            "motor",
            name=f"torq_{joint}",
            joint=joint,
            ctrlrange=limit,
            ctrllimited="true",
        )
    _name_geoms(base, "arm")
    # robosuite's controllers use it as the origin of the arm frame.
    ElementTree.SubElement(base, "site", _UNSEEN, name="right_center")
    return model


def _gripper(scene: Element) -> Element:
    """The bar with the fingers and everything below it, with the fingers' own drives."""
    hand = _without_gripper(_base(scene))
    for body in hand.iter("body"):
        body.attrib.pop("gravcomp", None)
    hand.attrib.clear()
    hand.set("name", "right_gripper")
    (tcp,) = (site for site in hand.findall("site") if site.get("name") == "tcp")
    hand.remove(tcp)
    eef = ElementTree.SubElement(hand, "body", name="eef", pos=tcp.attrib["pos"])
    ElementTree.SubElement(hand, "site", _UNSEEN, name="ft_frame")
    for name in ("grip_site", "ee_x", "ee_y", "ee_z"):
        ElementTree.SubElement(eef, "site", _UNSEEN, name=name)
    line = {**_UNSEEN, "size": "0.002 0.002", "type": "cylinder"}
    ElementTree.SubElement(eef, "site", line, name="grip_site_cylinder")
    model = _model("widowx_gripper", scene, [hand])
    actuator = ElementTree.SubElement(model, "actuator")
    settings = _any_task().settings
    for drive in scene.iter("position"):
        if "finger" in drive.attrib["joint"]:
            limits = f"{settings.gripper_closed} {settings.gripper_open}"
            ElementTree.SubElement(
                actuator, "position", drive.attrib, ctrlrange=limits, ctrllimited="true"
            )
    sensor = ElementTree.SubElement(model, "sensor")
    ElementTree.SubElement(sensor, "force", name="force_ee", site="ft_frame")
    ElementTree.SubElement(sensor, "torque", name="torque_ee", site="ft_frame")
    _name_geoms(hand, "hand")
    return model


def _arena(scene: Element) -> Element:
    """The scene without the robot."""
    bodies = [node for node in _worldbody(scene) if node.get("name") != "base_link"]
    for index, body in enumerate(bodies):
        _name_geoms(body, f"arena_{index}")
    return _model("bridge", scene, bodies)


def _model(name: str, scene: Element, bodies: list[Element]) -> Element:
    """A model with the materials of its bodies; robosuite keeps one of two with the same name."""
    model = ElementTree.Element("mujoco", model=name)
    ElementTree.SubElement(model, "compiler", angle="radian", autolimits="true")
    asset = ElementTree.SubElement(model, "asset")
    used = {geom.get("material") for body in bodies for geom in body.iter("geom")}
    for assets in scene.findall("asset"):
        asset.extend(
            copy.deepcopy(one) for one in assets if one.tag != "material" or one.get("name") in used
        )
    ElementTree.SubElement(model, "worldbody").extend(bodies)
    return model


def _worldbody(scene: Element) -> Iterator[Element]:
    for node in scene.findall("worldbody"):
        yield from list(node)


def _base(scene: Element) -> Element:
    (base,) = (node for node in _worldbody(scene) if node.get("name") == "base_link")
    return base


def _without_gripper(base: Element) -> Element:
    """Replaces the gripper by robosuite's empty hand and returns the gripper."""
    for parent in base.iter("body"):
        for index, child in enumerate(parent):
            if child.get("name") == _HAND:
                parent[index] = ElementTree.Element(
                    "body", name="right_hand", pos=child.attrib["pos"]
                )
                return child
    raise AssertionError(f"the robot has a body {_HAND}")


def _name_geoms(root: Element, prefix: str) -> None:
    """Names every geom, as robosuite requires, and moves collision geoms to its hidden group 0."""
    geoms = [root] if root.tag == "geom" else list(root.iter("geom"))
    for index, geom in enumerate(geoms):
        geom.attrib.setdefault("name", f"{prefix}_{index}")
        if geom.get("group") == "3":
            geom.set("group", "0")


@contextmanager
def _written(model: Element) -> Iterator[str]:
    """The path of a temporary file with the model."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        ElementTree.ElementTree(model).write(path)
        yield str(path)
