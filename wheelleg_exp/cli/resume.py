"""``wheelleg resume RUN`` and ``wheelleg resume --sweep SWEEP``."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_config_dir, add_json, add_root, offer, together
from wheelleg_exp.cli.printing.terminal import shown
from wheelleg_exp.cli.train import print_trained, train_on
from wheelleg_exp.torchrun import require_alone, world_size

if TYPE_CHECKING:
    from wheelleg_exp.rl.ranks import Ranks
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.stop_request import StopRequest


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, or 'latest'; or the folder or id of a pipeline"
    offer("run to resume", parser.add_argument("run", metavar="RUN", help=text))
    text = "changes for the remaining training: agent.max_iterations=200 (in total), env.rewards.alive.weight=2, ..."
    offer("override", parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help=text))
    text = "RUN is the folder or id of a sweep, or 'latest': resume its unfinished runs, and train its missing runs"
    parser.add_argument("--sweep", action="store_true", help=text)
    add_root(parser)
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Resume a run from the run's last complete checkpoint, as if the training had never stopped."""
    from wheelleg_exp.stop_request import StopRequest

    with StopRequest() as stop:
        if args.sweep:
            from wheelleg_exp.cli.train import resume_sweep

            require_alone("--sweep")
            return resume_sweep(args, stop)
        return together(_resume, _follow, args, stop) if world_size() > 1 else _resume(args, stop)


def _resume(args: argparse.Namespace, stop: StopRequest, ranks: Ranks | None = None) -> int:
    from wheelleg_exp.run.run_directory import PIPELINE_NAME, PIPELINES, is_pipeline

    with ranks.agreed() if ranks else nullcontext():
        run, root = Path(args.run), Path(args.root)
        places = [run, root / PIPELINES / run, root / run, *([run.parent] if run.name == PIPELINE_NAME else [])]
        pipeline = next((place.resolve() for place in places if is_pipeline(place)), None)
        if pipeline is not None:
            require_alone("pipeline")
        else:
            directory = _opened(args)
    if pipeline is not None:
        from wheelleg_exp.cli.train import resume_pipeline

        return resume_pipeline(args, pipeline, stop)

    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.train import resume_training
    from wheelleg_exp.rl.ranks import ALONE

    with ConsoleDisplay(quiet=True) as display:
        stop.check(ranks.any(stop.requested) if ranks else None)
        display.note(f"run directory: {shown(directory.path)}")
        ready = resume_training.prepare_resume(
            directory, args.overrides, args.command, display, args.config_dirs, ranks or ALONE
        )
        results = train_on(ready, display, stop)
    return print_trained(directory, results, as_json=args.json)


def _follow(args: argparse.Namespace, stop: StopRequest, ranks: Ranks) -> None:
    """Resume a training run in a process whose rank is not 0."""
    with ranks.agreed():
        _opened(args)

    from wheelleg_exp.jobs.train.resume_training import prepare_other_rank
    from wheelleg_exp.jobs.train.run_training import run_other_rank

    stop.check(ranks.any(stop.requested))
    run_other_rank(*prepare_other_rank(ranks, args.config_dirs), stop)


def _opened(args: argparse.Namespace) -> RunDirectory:
    """Open the run to resume, and make MKL use the same matrix kernels as before the interruption."""
    from wheelleg_exp.machine import keep_kernels
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.run.stock_policies import refuse_stock

    directory = RunDirectory.open(args.run, args.root)
    refuse_stock(directory.path, directory.manifest().data.get("stock"))
    keep_kernels(directory.manifest().data.get("environment_variables") or {})
    return directory
