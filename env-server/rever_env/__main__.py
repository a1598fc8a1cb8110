"""Command line: expert (success table), demonstrate (training episodes), serve, trace and more."""

import argparse
import os
import sys
from pathlib import Path

from rever_env import health, opengl, serving


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
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rever_env", description=__doc__)
    commands = parser.add_subparsers(required=True)

    expert = commands.add_parser("expert", help="measure the scripted expert's success")
    _add_tasks(expert)
    expert.add_argument("--episodes", type=int, default=200, help="random layouts per task")
    expert.add_argument("--seed", type=int, default=4_000_000_000)
    expert.add_argument("--processes", type=int, default=2)
    expert.add_argument("--robosuite", action="store_true", help="in robosuite")
    expert.set_defaults(run=_expert)

    demonstrate = commands.add_parser("demonstrate", help="record expert episodes for training")
    _add_tasks(demonstrate)
    demonstrate.add_argument("--episodes", type=int, required=True, help="per task")
    demonstrate.add_argument("--seed", type=int, default=0, help="first seed")
    demonstrate.add_argument("--out", type=Path, required=True)
    demonstrate.add_argument("--noise", action="store_true", help="inject noise into the actions")
    demonstrate.add_argument("--processes", type=int, default=2)
    demonstrate.set_defaults(run=_demonstrate)

    serve = commands.add_parser("serve", help="offer the worlds over zenoh")
    serving.add_arguments(serve)

    check = commands.add_parser("health", help="ask servers whether they still work")
    health.add_arguments(check)

    trace = commands.add_parser("trace", help="print every number of episodes")
    _add_tasks(trace)
    trace.add_argument("--layouts", nargs="+", type=int, help="default: drawn from the seeds")
    trace.add_argument("--seeds", nargs="+", type=int, default=[0])
    trace.add_argument("--side", type=int, default=128, help="of the image (default: 128)")
    trace.add_argument(
        "--actions", type=Path, metavar="FILE", help="7 numbers per line (default: the expert's)"
    )
    trace.set_defaults(run=_trace)

    times = commands.add_parser("bench", help="time a control step with its image")
    _add_tasks(times)
    times.add_argument("--steps", type=int, default=200, help="per task and kind (default: 200)")
    times.add_argument("--side", type=int, default=224, help="of the image (default: 224)")
    times.add_argument(
        "--robosuite", action="store_true", help="with robosuite's Stack and Panda in turns"
    )
    times.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
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
