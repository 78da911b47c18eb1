"""``wheelleg train``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from wheelleg_exp.cli.common import add_json, add_overrides
from wheelleg_exp.cli.printing.outcome import tell_trained, train_on

if TYPE_CHECKING:
    from wheelleg_exp.jobs.stop import StopRequest


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    add_json(parser)
    parser.add_argument(
        "-m",
        "--multirun",
        action="store_true",
        help="train every combination of several values: seed=1,2,3 env.rewards.alive.weight=choice(1,2) "
        "[hydra/launcher=joblib hydra.launcher.n_jobs=2]",
    )


def run(args: argparse.Namespace) -> int:
    """Compose, check, train, and say what was made."""
    from wheelleg_exp.jobs.stop import StopRequest

    piped = [word for word in args.overrides if word.lstrip("+~").startswith(("pipeline=", "pipeline."))]
    # From the first moment on: an interrupt inside the import of a C++ library may be lost or become another error.
    with StopRequest() as stop:
        if piped:
            from wheelleg_exp.cli.pipeline import train_pipeline

            return train_pipeline(args, piped, stop)
        if args.multirun:
            from wheelleg_exp.cli.sweep import train_all

            return train_all(args, stop)
        return _train(args, stop)


def _train(args: argparse.Namespace, stop: StopRequest) -> int:
    from wheelleg_exp.config.checking.collect import compose_valid

    composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.cli.printing.display import ConsoleDisplay
    from wheelleg_exp.cli.printing.figures import shown
    from wheelleg_exp.cli.printing.tables import hanging
    from wheelleg_exp.jobs.train import training
    from wheelleg_exp.lint.examine import examine

    with ConsoleDisplay() as display:
        stop.check()
        ready = training.prepare(composed, args.command, display)
        directory = ready.directory
        display.note(f"run directory: {shown(directory.path)}")
        for finding in examine(composed).open:
            display.note(hanging(f"warning: {finding.line()}", 4))
        results = train_on(ready, display, stop)
    return tell_trained(directory, results, as_json=args.json)
