"""Reasoning: the chain of thought of one step, in ECoT's order, from a closed set of phrases."""

from collections.abc import Iterable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rever_env.expert import SUBTASKS, Decision
from rever_env.tasks import Task

COORDINATES_SIDE = 256  # the image is mapped to a square of this side
COORDINATE_STEP = 2  # coordinates are multiples of this
Box = tuple[int, int, int, int]  # x1, y1, x2, y2, corners included

_AXES = (("forward", "backward"), ("left", "right"), ("up", "down"))  # base frame x, y, z
_MOVE_MIN = 0.003  # metres: a smaller step is not called a move
_AXIS_SHARE = 0.35  # an axis is named if its share of the largest one is at least this
_TURN_MIN = 0.05  # rad


def compose(
    task: Task, decision: Decision, opening: float, boxes: tuple[Box, Box], pixel: tuple[int, int]
) -> str:
    """The text before ` ACTION:`; begins with `TASK:`. opening: 0 closed to 1 open."""
    subtask = decision.subtask
    parts = [
        _opening_phrase(task),
        _box_text(boxes[0]),
        _second_phrase(task),
        _box_text(boxes[1]),
        _subtask_phrase(task, subtask),
        _move_reasoning_phrase(task, subtask),
        f" {move_words(decision, opening)}",
        _GRIPPER_PHRASE,
        f" [{pixel[0]}, {pixel[1]}]",
    ]
    return "".join(parts).removeprefix(" ")


def phrases(tasks: Iterable[Task]) -> list[str]:
    """All fixed segments of ` ` + text + ` ACTION:` between coordinates and choices."""
    tasks = list(tasks)
    found: list[str] = []
    for task in tasks:
        found += [_opening_phrase(task), _second_phrase(task)]
        for subtask in SUBTASKS:
            found += [_subtask_phrase(task, subtask), _move_reasoning_phrase(task, subtask)]
    found += [f" {words}" for words in all_moves()]
    found += [_GRIPPER_PHRASE, " ACTION:"]
    return list(dict.fromkeys(found))


def all_moves() -> list[str]:
    """The closed set of MOVE texts."""
    directions = [
        "move " + " ".join(word for word in words if word)
        for words in product(*[("", *pair) for pair in _AXES])
        if any(words)
    ]
    return [*directions, "rotate gripper", "open gripper", "close gripper", "stop"]


def move_words(decision: Decision, opening: float) -> str:
    """The MOVE text of an action."""
    translation = decision.action[:3]
    largest = float(np.abs(translation).max())
    if largest >= _MOVE_MIN:
        words = [
            pair[0] if value > 0.0 else pair[1]
            for value, pair in zip(translation, _AXES, strict=True)
            if abs(value) >= max(_AXIS_SHARE * largest, _MOVE_MIN)
        ]
        return "move " + " ".join(words)
    if abs(decision.action[5]) >= _TURN_MIN:
        return "rotate gripper"
    if decision.action[6] < 0.0:
        return "close gripper" if decision.subtask == "grasp" else "stop"
    return "open gripper" if opening < 0.85 else "stop"


def visible_box(bodies: NDArray[np.int32], body: int) -> Box | None:
    """The box of a body's visible pixels in the square of side 256; None if it is hidden."""
    height, width = bodies.shape
    rows, columns = np.nonzero(bodies == body)
    if len(rows) == 0:
        return None
    return (
        _even(columns.min() / width),
        _even(rows.min() / height),
        _even(columns.max() / width),
        _even(rows.max() / height),
    )


def square_pixel(x: float, y: float) -> tuple[int, int]:
    """An image point (each coordinate 0 to 1) as even coordinates inside the square."""
    return _even(x), _even(y)


_GRIPPER_PHRASE = " GRIPPER POSITION:"


def _opening_phrase(task: Task) -> str:
    source, target = task.source_phrase, task.target_phrase
    return (
        f" TASK: {task.instruction} PLAN: reach the {source}, grasp it, lift it, "
        f"move it over the {target}, release it VISIBLE OBJECTS: {source}"
    )


def _second_phrase(task: Task) -> str:
    return f", {task.target_phrase}"


def _subtask_phrase(task: Task, subtask: str) -> str:
    source, target = task.source_phrase, task.target_phrase
    reason, name = {
        "reach": (
            f"the {source} is not grasped yet and the gripper is away from it",
            f"reach the {source}",
        ),
        "grasp": (f"the gripper is around the {source}", f"grasp the {source}"),
        "lift": (f"the {source} is grasped and still low", f"lift the {source}"),
        "move": (
            f"the {source} is lifted and not yet over the {target}",
            f"move the {source} over the {target}",
        ),
        "release": (f"the {source} is over the {target}", f"release the {source}"),
        "done": (f"the {source} lies on the {target} and is released", "stay away"),
    }[subtask]
    return f" SUBTASK REASONING: {reason} SUBTASK: {name}"


def _move_reasoning_phrase(task: Task, subtask: str) -> str:
    source, target = task.source_phrase, task.target_phrase
    reason = {
        "reach": f"the gripper must come down around the {source} from above",
        "grasp": f"the fingers must close on the {source}",
        "lift": f"the {source} must come clear of what is around it",
        "move": f"the gripper must carry the {source} over the {target}",
        "release": f"the {source} must be set down on the {target} and let go",
        "done": f"the gripper must leave the {source} alone",
    }[subtask]
    return f" MOVE REASONING: {reason} MOVE:"


def _box_text(box: Box) -> str:
    return f" [{box[0]}, {box[1]}, {box[2]}, {box[3]}]"


def _even(share: float) -> int:
    step = COORDINATE_STEP
    value = int(share * COORDINATES_SIDE // step) * step
    return min(max(value, 0), COORDINATES_SIDE - step)
