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
    os.environ["SDL_VIDEODRIVER"] = "dummy"  # Gymnasium's own images need no screen
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
        prog="rever_env", description="The Bridge tasks in MuJoCo, and servers of any simulator."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    expert = commands.add_parser("expert", help="measure the success rate of the scripted expert")
    _add_tasks(expert)
    expert.add_argument(
        "--episodes", type=count, default=200, help="random layouts per task (default: 200)"
    )
    expert.add_argument(
        "--seed", type=int, default=4_000_000_000, help="first seed (default: 4000000000)"
    )
    expert.add_argument("--processes", type=count, default=2, help="in parallel (default: 2)")
    expert.add_argument(
        "--robosuite", action="store_true", help="run the tasks in robosuite instead of MuJoCo"
    )
    expert.set_defaults(run=_expert)

    demonstrate = commands.add_parser("demonstrate", help="record expert episodes for training")
    _add_tasks(demonstrate)
    demonstrate.add_argument("--episodes", type=count, required=True, help="episodes per task")
    demonstrate.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    demonstrate.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="where TASK/SEED.npz are written"
    )
    demonstrate.add_argument(
        "--noise", action="store_true", help="execute noisy actions; the labels stay the expert's"
    )
    demonstrate.add_argument("--processes", type=count, default=2, help="in parallel (default: 2)")
    demonstrate.set_defaults(run=_demonstrate)

    serve = commands.add_parser("serve", help="serve environments over zenoh")
    serving.add_arguments(serve)

    check = commands.add_parser("health", help="check that servers answer")
    health.add_arguments(check)

    trace = commands.add_parser("trace", help="print states, flags and image hashes of episodes")
    _add_tasks(trace)
    trace.add_argument(
        "--layouts", nargs="+", type=int, help="fixed layouts (default: drawn from the seeds)"
    )
    trace.add_argument("--seeds", nargs="+", type=int, default=[0], help="default: 0")
    trace.add_argument("--side", type=count, default=128, help="pixels per image side")
    trace.add_argument(
        "--actions", type=Path, metavar="FILE", help="7 numbers per line (default: the expert's)"
    )
    trace.set_defaults(run=_trace)

    times = commands.add_parser("bench", help="measure the time of a control step with its image")
    _add_tasks(times)
    times.add_argument(
        "--steps", type=count, default=200, help="steps per task and kind (default: 200)"
    )
    times.add_argument(
        "--side", type=count, default=224, help="pixels per image side (default: 224)"
    )
    times.add_argument(
        "--robosuite", action="store_true", help="compare with robosuite's Stack and a Panda"
    )
    times.add_argument("--json", type=Path, metavar="FILE", help="also write the results to a file")
    times.set_defaults(run=_bench)
    return parser


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
