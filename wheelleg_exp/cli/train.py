"""``wheelleg train``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from wheelleg_exp.cli.common import add_json, add_overrides, print_json
from wheelleg_exp.errors import EXIT_INTERRUPTED, EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.jobs.stop import StopRequest


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Compose, check, train, and say what was made."""
    from wheelleg_exp.jobs.stop import StopRequest

    # From the first moment on: an interrupt inside the import of a C++ library may be lost or become another error.
    with StopRequest() as stop:
        return _train(args, stop)


def _train(args: argparse.Namespace, stop: StopRequest) -> int:
    from wheelleg_exp.config.check import require_valid
    from wheelleg_exp.config.compose import compose

    composed = compose(args.overrides, config_dirs=args.config_dirs)
    require_valid(composed)

    from wheelleg_exp.cli.display import ConsoleDisplay
    from wheelleg_exp.cli.report import shown, tool
    from wheelleg_exp.jobs import training

    with ConsoleDisplay() as display:
        stop.check()
        ready = training.prepare(composed, args.command, display)
        directory = ready.directory
        display.note(f"run directory: {shown(directory.path)}")
        try:
            results = training.run(ready, display, stop)
        except KeyboardInterrupt:
            found = directory.checkpoints()
            last = f"the last checkpoint is {shown(found[-1])}" if found else "there is no checkpoint yet"
            display.note(f"interrupted; {last}")
            return EXIT_INTERRUPTED
    if args.json:
        print_json({"run": str(directory.path), "status": "finished", "results": results})
        return EXIT_OK
    path = shown(directory.path)
    print(f"trained {results['iterations']} iterations in {results['seconds']:.0f} s: {path}")
    print(f"next: {tool('wheelleg')} play {path}")
    print(f"      {tool('tensorboard')} --logdir {path}")
    if directory.recording.is_file():
        print(f"      {tool('rerun')} {path}/recording.rrd")
    return EXIT_OK
