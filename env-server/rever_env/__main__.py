"""The command line: expert, demonstrate, serve, health, trace, bench."""

import argparse
import os
import sys
from pathlib import Path

from rever_env import health, opengl, serving
from rever_env.argument_types import count


def main() -> int:
    """Parses, calls one library function, prints one error, returns the exit status."""
    arguments = _parser().parse_args()
    for warning in opengl.isolate_process():
        print(f"warning: {warning}", file=sys.stderr)
    os.environ["SDL_VIDEODRIVER"] = "dummy"  # pygame renders Gymnasium's own images offscreen
    from rever_env.fault import Fault

    try:
        return int(arguments.run(arguments))
    except Fault as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        what = "" if error.filename is None else f"cannot use {error.filename}: "
        print(f"error: {what}{error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rever_env",
        description="Serve environments, record expert demonstrations, and measure both.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, purpose: str) -> argparse.ArgumentParser:
        description = f"{purpose[0].upper()}{purpose[1:]}."
        return commands.add_parser(name, help=purpose, description=description)

    expert = add("expert", "measure the success rate of the scripted expert")
    _add_tasks(expert)
    expert.add_argument(
        "--episodes", type=count, default=200, help="random layouts per task (default: 200)"
    )
    expert.add_argument(
        "--seed", type=int, default=4_000_000_000, help="first seed (default: 4000000000)"
    )
    expert.add_argument("--processes", type=count, default=2, help="worker processes (default: 2)")
    expert.add_argument(
        "--robosuite", action="store_true", help="run the tasks in robosuite instead of MuJoCo"
    )
    expert.set_defaults(run=_expert)

    _add_demonstrate(add("demonstrate", "record expert episodes for training"))
    serving.add_arguments(add("serve", "serve environments over zenoh"))
    health.add_arguments(add("health", "check that servers answer"))
    _add_trace(add("trace", "print states, flags and image hashes of episodes"))
    _add_bench(add("bench", "measure the time of a control step with its image"))
    return parser


def _add_demonstrate(demonstrate: argparse.ArgumentParser) -> None:
    _add_tasks(demonstrate)
    demonstrate.add_argument("--episodes", type=count, required=True, help="episodes per task")
    demonstrate.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    demonstrate.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="write to FOLDER/TASK/SEED.npz"
    )
    demonstrate.add_argument(
        "--noise",
        action="store_true",
        help="execute the expert's actions with noise; the labels stay noise-free",
    )
    demonstrate.add_argument(
        "--processes", type=count, default=2, help="worker processes (default: 2)"
    )
    demonstrate.set_defaults(run=_demonstrate)


def _add_trace(trace: argparse.ArgumentParser) -> None:
    _add_tasks(trace)
    trace.add_argument(
        "--layouts",
        nargs="+",
        type=int,
        metavar="LAYOUT",
        help="fixed initial layouts (default: random ones, drawn from the seeds)",
    )
    trace.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        default=[0],
        metavar="SEED",
        help="one episode for each seed (default: 0)",
    )
    trace.add_argument(
        "--side", type=count, default=128, help="pixels per image side (default: 128)"
    )
    trace.add_argument(
        "--actions",
        type=Path,
        metavar="FILE",
        help="execute these actions, 7 numbers per line (default: the scripted expert's)",
    )
    trace.set_defaults(run=_trace)


def _add_bench(times: argparse.ArgumentParser) -> None:
    _add_tasks(times)
    times.add_argument(
        "--steps", type=count, default=200, help="steps per task and kind (default: 200)"
    )
    times.add_argument(
        "--side", type=count, default=224, help="pixels per image side (default: 224)"
    )
    times.add_argument(
        "--robosuite", action="store_true", help="also measure robosuite's Stack with a Panda"
    )
    times.add_argument("--json", type=Path, metavar="FILE", help="also write the results to a file")
    times.set_defaults(run=_bench)


def _add_tasks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--tasks",
        nargs="+",
        metavar="TASK",
        help="TASK, TASK/VARIANT, TASK/all, or all (default: every task in its default variant)",
    )


def _demonstrate(arguments: argparse.Namespace) -> int:
    from rever_env import demonstrations, tasks

    counts = demonstrations.demonstrate(
        tasks.choose(tasks.load(), arguments.tasks),
        arguments.episodes,
        arguments.seed,
        arguments.out,
        noisy=arguments.noise,
        processes=arguments.processes,
        report=lambda line: print(line, file=sys.stderr, flush=True),
    )
    for name, (kept, failed) in counts.items():
        print(f"{name}: {kept} kept, {failed} failed")
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    from rever_env import bench, tasks

    return bench.bench(
        tasks.choose(tasks.load(), arguments.tasks),
        arguments.side,
        arguments.steps,
        with_robosuite=arguments.robosuite,
        file=arguments.json,
    )


def _trace(arguments: argparse.Namespace) -> int:
    from rever_env import tasks, trace

    layouts = arguments.layouts or [None]
    starts = [(layout, seed) for layout in layouts for seed in arguments.seeds]
    for task in tasks.choose(tasks.load(), arguments.tasks):
        for line in trace.lines(task, starts, arguments.actions, arguments.side):
            print(line)
    return 0


def _expert(arguments: argparse.Namespace) -> int:
    from rever_env import measurement, tasks

    rows = measurement.measure(
        tasks.choose(tasks.load(), arguments.tasks),
        arguments.episodes,
        arguments.seed,
        processes=arguments.processes,
        report=lambda line: print(line, file=sys.stderr, flush=True),
        in_robosuite=arguments.robosuite,
    )
    print(measurement.table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
