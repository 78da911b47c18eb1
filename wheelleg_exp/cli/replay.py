"""``wheelleg replay RUN``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json, offer, print_json
from wheelleg_exp.cli.printing.terminal import shown
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.description = (
        "Re-run a training from its snapshot alone, and compare. This runs the code of the run's commit plus the "
        "run's patch, with all your rights: replay only runs from people whose code you would run."
    )
    offer("run", parser.add_argument("run", metavar="RUN", help="a run directory, its id, or 'latest'"))
    text = "a clone that contains the run's commit (repeatable); "
    text += "by default the recorded folder, then the current checkout"
    parser.add_argument(
        "--repository", dest="repositories", action="append", type=Path, default=[], metavar="DIR", help=text
    )
    text = "train N iterations and compare these; by default all"
    parser.add_argument("--iterations", type=int, metavar="N", help=text)
    parser.add_argument("--keep", action="store_true", help="do not delete the restored source, and print its path")
    text = "the folder of the runs; the replay is written to its subfolder replays/ (default: runs)"
    parser.add_argument("--root", type=Path, default=Path("runs"), help=text)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Restore a run's source code, repeat the training, and print how the new run differs from the original run."""
    from wheelleg_exp.stop_request import StopRequest

    with StopRequest() as stop:
        from wheelleg_exp.run.run_directory import RunDirectory
        from wheelleg_exp.run.stock_policies import refuse_stock

        directory = RunDirectory.open(args.run, args.root)
        refuse_stock(directory.path, directory.manifest().data.get("stock"))

        from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
        from wheelleg_exp.jobs.replay.replay_run import replay

        again = partial(replay, repositories=args.repositories, iterations=args.iterations, keep=args.keep)
        with ConsoleDisplay() as display:
            found = again(directory, args.command, display, stop, root=args.root)
    status = EXIT_FINDING if found.comparison.verdict == "different" else EXIT_OK
    if args.json:
        print_json(found.as_dict())
        return status

    iterations = f"{found.iterations} iteration{'' if found.iterations == 1 else 's'}"
    part = "all" if found.whole else "the first"
    print(f"replayed {part} {iterations} of {shown(found.original.path)}: {shown(found.run.path)}")
    if found.kept is not None:
        print(f"restored source: {found.kept}")
    for line in found.comparison.lines():
        print(line)
    return status
