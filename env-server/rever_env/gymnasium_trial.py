"""Checks a Gymnasium environment before it is served: determinism, first steps, rendering."""

import dataclasses
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from rever_env.fault import RendererUnavailable
from rever_env.gymnasium_tasks import GymnasiumTask
from rever_env.gymnasium_world import GymnasiumWorld
from rever_env.protocol import Dimension

_STEPS = 5
_SIDE = 64  # pixels


def tried(task: GymnasiumTask) -> tuple[GymnasiumTask, list[str]]:
    """The task as it can be served, and warnings about the checks that failed."""
    warnings = [f"environment {task.name}: {words}" for words in _broken_promises(task)]
    if task.image_part is None and task.renders:
        try:
            with closing(GymnasiumWorld(task, _SIDE, _SIDE)) as world:
                world.reset(layout=None, seed=0)
        except RendererUnavailable as error:
            task = dataclasses.replace(task, renders=False)
            warnings.append(f"environment {task.name} is served without images: {error}")
    return task, warnings


def _broken_promises(task: GymnasiumTask) -> list[str]:
    """Warnings if episodes with the same seed and actions differ, or if the first steps fail."""
    random = np.random.default_rng(0)
    actions = [
        np.array([_number(dimension, random) for dimension in task.action]) for _ in range(_STEPS)
    ]
    try:
        with (
            closing(GymnasiumWorld(task, 0, 0)) as one,
            closing(GymnasiumWorld(task, 0, 0)) as other,
        ):
            expected = _episode(one, actions)
            where = None
            if _episode(other, actions) != expected:
                where = "another instance"
            elif _episode(one, actions) != expected:
                where = "the next episode"
    except Exception as error:  # the environment's code may raise errors of any type
        return [f"a reset and {_STEPS} random steps fail: {type(error).__name__}: {error}"]
    if where is None:
        return []
    return [
        f"the same seed and actions give different observations in {where}: episodes are not "
        "reproducible, and restoring a saved state will fail"
    ]


def _episode(world: GymnasiumWorld, actions: list[NDArray[np.float64]]) -> list[list[bytes]]:
    """All observations and rewards until the actions or the episode end."""
    world.reset(layout=None, seed=0)
    seen = [world.seen()]
    for action in actions:
        transition = world.step(action)
        seen.append([*world.seen(), np.float64(transition.reward).tobytes()])
        if transition.terminated or transition.truncated:
            break
    return seen


def _number(dimension: Dimension, random: np.random.Generator) -> float:
    """A random number within the bounds."""
    low = -1.0 if dimension.low is None else dimension.low
    high = 1.0 if dimension.high is None else dimension.high
    if dimension.discrete:
        return float(random.integers(int(low), int(high) + 1))
    return float(random.uniform(low, high))
