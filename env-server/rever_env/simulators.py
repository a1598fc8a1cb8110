"""The simulators that a server can offer: their command-line options and their worlds."""

import argparse
import logging
from typing import TYPE_CHECKING

from rever_env import opengl
from rever_env.argument_types import count, json_object
from rever_env.fault import RendererUnavailable
from rever_env.protocol import limits

if TYPE_CHECKING:
    from rever_env.worlds import Worlds

_log = logging.getLogger(__name__)

_ROBOTS, _CONTROL_HZ, _HORIZON = ("Panda",), 20.0, 500


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options that choose tasks and simulator."""
    group = parser.add_argument_group(
        "simulators", "Default: all Bridge tasks in MuJoCo, in all variants."
    )
    kinds = group.add_mutually_exclusive_group()
    kinds.add_argument(
        "--tasks",
        nargs="+",
        metavar="TASK",
        help="serve these Bridge tasks: TASK, TASK/VARIANT or TASK/all (default: all)",
    )
    kinds.add_argument(
        "--robosuite",
        nargs="+",
        metavar="TASK",
        help="serve tasks of robosuite, such as Lift, or Bridge tasks in robosuite, named as for "
        "--tasks (bridge: all of them)",
    )
    kinds.add_argument(
        "--gymnasium", nargs="+", metavar="ID", help="serve these Gymnasium environments"
    )
    group.add_argument(
        "--horizon",
        type=count,
        metavar="STEPS",
        help="truncate episodes of robosuite's own tasks, and of Gymnasium ids without a limit, "
        f"after so many control steps (default: {_HORIZON})",
    )
    _add_robosuite_arguments(parser)
    _add_gymnasium_arguments(parser)


def _add_robosuite_arguments(parser: argparse.ArgumentParser) -> None:
    robosuite = parser.add_argument_group("options of --robosuite, for robosuite's own tasks")
    robosuite.add_argument(
        "--robots",
        nargs="+",
        metavar="ROBOT",
        help="offer each task with each of these robots; ROBOT+ROBOT for two-armed tasks "
        f"(default: {' '.join(_ROBOTS)})",
    )
    robosuite.add_argument(
        "--control-hz",
        type=float,
        metavar="HZ",
        help=f"control steps per second (default: {_CONTROL_HZ:g})",
    )


def _add_gymnasium_arguments(parser: argparse.ArgumentParser) -> None:
    gymnasium = parser.add_argument_group("options of --gymnasium")
    gymnasium.add_argument(
        "--import",
        dest="imports",
        nargs="+",
        metavar="PACKAGE",
        help="import these packages first, to register the ids",
    )
    gymnasium.add_argument(
        "--arguments",
        type=json_object,
        metavar="JSON",
        help="keyword arguments for gymnasium.make, as a JSON object",
    )
    gymnasium.add_argument(
        "--wrapper",
        metavar="MODULE:CLASS",
        help="apply this wrapper to each environment, as the outermost one",
    )
    gymnasium.add_argument(
        "--image-key",
        metavar="KEY",
        help="the image in a Dict observation, such as images.front (default: the first image)",
    )
    gymnasium.add_argument(
        "--instruction-key",
        metavar="KEY",
        help="the instruction, a Text in a Dict observation (default: the first Text; if there is "
        "none, the environment's attribute task_description, instruction or language_instruction; "
        "else its id)",
    )
    gymnasium.add_argument(
        "--state-keys",
        nargs="+",
        metavar="KEY",
        help="the parts of a Dict observation that form the state, in this order (default: all "
        "numeric parts)",
    )


class UnusedOption(ValueError):
    """An option that would have no effect."""


def make_worlds(arguments: argparse.Namespace, idle_max: int) -> "Worlds":
    """The worlds that the options choose; UnusedOption if an option would have no effect."""
    _check_used(arguments)
    if arguments.gymnasium:
        return _gymnasium(arguments, idle_max)
    reason = opengl.unavailable()
    if reason:
        _log.warning("cannot render images; sessions with images are refused: %s", reason)
    if arguments.robosuite:
        return _robosuite(arguments, idle_max)
    from rever_env import tasks
    from rever_env.worlds import Worlds

    chosen = tasks.choose(tasks.load(), arguments.tasks or [tasks.ALL])
    return Worlds({str(task.id): task for task in chosen}, idle_max)


def _robosuite(arguments: argparse.Namespace, idle_max: int) -> "Worlds":
    from rever_env import robosuite_tasks, robosuite_world
    from rever_env.worlds import Worlds

    offered = robosuite_tasks.offered(
        arguments.robosuite,
        arguments.robots or _ROBOTS,
        arguments.horizon or _HORIZON,
        _CONTROL_HZ if arguments.control_hz is None else arguments.control_hz,
    )
    return Worlds(
        offered,
        idle_max,
        robosuite_world.RobosuiteWorld,
        robosuite_tasks.simulator(),
    )


def _gymnasium(arguments: argparse.Namespace, idle_max: int) -> "Worlds":
    try:
        opengl.choose_device_for_other_libraries()
    except RendererUnavailable as error:
        _log.warning("OpenGL is not available to the environments: %s", error)
    from rever_env import gymnasium_tasks, gymnasium_trial, gymnasium_world
    from rever_env.worlds import Worlds

    imports = arguments.imports or ()
    wrapper = gymnasium_tasks.imported(arguments.wrapper) if arguments.wrapper else None
    state_keys = tuple(arguments.state_keys) if arguments.state_keys else None
    offered = gymnasium_tasks.offered(
        arguments.gymnasium,
        imports,
        gymnasium_tasks.Making(arguments.arguments or {}, wrapper),
        arguments.horizon or _HORIZON,
        gymnasium_tasks.Keys(arguments.image_key, arguments.instruction_key, state_keys),
    )
    if arguments.horizon and all(map(gymnasium_tasks.has_limit, offered)):
        raise UnusedOption("--horizon has no effect: every environment has its own step limit")
    for name, task in offered.items():
        offered[name], warnings = gymnasium_trial.tried(task)
        for words in warnings:
            _log.warning("%s", words)
    has_images = any(task.has_image for task in offered.values())
    return Worlds(
        offered,
        idle_max,
        gymnasium_world.GymnasiumWorld,
        gymnasium_tasks.simulator(imports),
        limits.IMAGE_SIDE_MAX if has_images else 0,
    )


def _check_used(arguments: argparse.Namespace) -> None:
    """UnusedOption for an option that the chosen simulator ignores."""
    from rever_env import tasks

    bridge = {tasks.BRIDGE, *(task.name for task in tasks.load().values())}
    named = {tasks.TaskId.parse(name).task for name in arguments.robosuite or ()}
    has_own_robosuite = bool(named - bridge)
    is_gymnasium = bool(arguments.gymnasium)
    of_robosuite = (has_own_robosuite, "--robosuite and one of robosuite's own tasks")
    of_gymnasium = (is_gymnasium, "--gymnasium")
    for option, (is_used, wanted) in {
        "robots": of_robosuite,
        "control_hz": of_robosuite,
        "horizon": (
            has_own_robosuite or is_gymnasium,
            "--gymnasium, or --robosuite and one of robosuite's own tasks",
        ),
        "imports": of_gymnasium,
        "arguments": of_gymnasium,
        "wrapper": of_gymnasium,
        "image_key": of_gymnasium,
        "instruction_key": of_gymnasium,
        "state_keys": of_gymnasium,
    }.items():
        if getattr(arguments, option) is not None and not is_used:
            name = "import" if option == "imports" else option.replace("_", "-")
            raise UnusedOption(f"--{name} has no effect without {wanted}")
