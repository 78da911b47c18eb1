"""``wheelleg train``."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from typing import TYPE_CHECKING

from wheelleg_exp.cli.common import add_json, add_overrides, together
from wheelleg_exp.cli.printing.outcome import tell_trained, train_on
from wheelleg_exp.torchrun import require_alone, world_size

if TYPE_CHECKING:
    from wheelleg_exp.config.composing.compose import Composed
    from wheelleg_exp.jobs.stop import StopRequest
    from wheelleg_exp.rl.ranks import Ranks


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
    from wheelleg_exp.config.composing.primaries import names_pipeline
    from wheelleg_exp.jobs.stop import StopRequest

    # From the first moment on: an interrupt inside the import of a C++ library may be lost or become another error.
    with StopRequest() as stop:
        if any(map(names_pipeline, args.overrides)):
            from wheelleg_exp.cli.pipeline import train_pipeline

            require_alone("pipeline")
            return train_pipeline(args, stop)
        if args.multirun:
            from wheelleg_exp.cli.sweep import train_all

            require_alone("--multirun")
            return train_all(args, stop)
        return together(train_one, _follow, args, stop) if world_size() > 1 else train_one(args, stop)


def train_one(args: argparse.Namespace, stop: StopRequest, ranks: Ranks | None = None) -> int:
    """Train one run; among several processes, as the first of them."""
    from wheelleg_exp.config.checking.collect import compose_valid

    with ranks.agreed() if ranks else nullcontext():
        composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.cli.printing.display import ConsoleDisplay
    from wheelleg_exp.cli.printing.figures import shown
    from wheelleg_exp.cli.printing.tables import hanging
    from wheelleg_exp.jobs.train import training
    from wheelleg_exp.lint.examine import examine
    from wheelleg_exp.rl.ranks import ALONE

    with ConsoleDisplay() as display:
        stop.check(ranks.any(stop.requested) if ranks else None)
        if ranks:
            ranks.require_equal(_digests(composed))
        ready = training.prepare(composed, args.command, display, ranks or ALONE)
        directory = ready.directory
        display.note(f"run directory: {shown(directory.path)}")
        for finding in examine(composed).open:
            display.note(hanging(f"warning: {finding.line()}", 4))
        results = train_on(ready, display, stop)
    return tell_trained(directory, results, as_json=args.json)


def _follow(args: argparse.Namespace, stop: StopRequest, ranks: Ranks) -> None:
    """Train with the first process."""
    from wheelleg_exp.config.checking.collect import compose_valid

    with ranks.agreed():
        composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.jobs.train import follow

    stop.check(ranks.any(stop.requested))
    ranks.require_equal(_digests(composed))
    follow.run(follow.prepare(composed, ranks), composed.config["agent"], stop)


def _digests(composed: Composed) -> dict[str, str]:
    from wheelleg_exp.config.composing.sweep import digest_of

    return {"the composed config": digest_of(composed)}
