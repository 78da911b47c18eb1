"""Going on with a run by several processes: what the first tells the others, and what they do with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.jobs.resume.loading import load, recipe_of
from wheelleg_exp.jobs.resume.point import ResumePoint
from wheelleg_exp.jobs.train import training
from wheelleg_exp.packages import join_recorded
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.ranks import Ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.manifest import Manifest


def require_as_many(manifest: Manifest, ranks: Ranks) -> None:
    """Refuse to go on with another number of processes: environments and random streams belong to each of them.

    Raises:
        RunDirectoryError: the run was trained by more processes, or by fewer.
    """
    trained = int((manifest.data.get("ranks") or {}).get("world_size", 1))
    if trained == ranks.size:
        return
    command = f"wheelleg resume {manifest.directory.name}"
    raise RunDirectoryError(
        f"was trained by {_processes(trained)} and cannot go on with {_processes(ranks.size)}: each has environments "
        "and random numbers of its own",
        key=str(manifest.directory),
        expected=f"torchrun --nproc-per-node {trained} --no-python {command}" if trained > 1 else f"'{command}' alone",
    )


def tell_others(
    ranks: Ranks,
    run: RunDirectory,
    tree: Mapping[str, Any],
    recorded: Sequence[str],
    point: ResumePoint,
    learning_rate: float | None,
) -> None:
    """Tell the other processes what they go on with (``follow``)."""
    ranks.said_by_first(
        {
            "run": str(run.path),
            "tree": tree,
            "recorded": [str(folder) for folder in recorded],
            "checkpoint": None if point.checkpoint is None else str(point.checkpoint),
            "learning_rate": learning_rate,
        }
    )


def follow(ranks: Ranks, config_dirs: Sequence[Path]) -> tuple[Trainer, dict[str, Any]]:
    """Do what ``resume.prepare`` does in the first process, and return the training and its ``agent`` section.

    Raises:
        WheellegError: the first process says why it cannot go on.
    """
    with ranks.agreed():
        pass  # the first one reads the run
    told = ranks.said_by_first(None)
    run = RunDirectory(Path(told["run"]))
    with ranks.agreed():
        recipe = recipe_of(run, told["tree"], "", join_recorded(config_dirs, told["recorded"]))
        trainer, _ = training.build(recipe, ranks)
    why: list[str] = []
    with ranks.agreed():
        if told["checkpoint"] is not None:
            why = load(trainer, checkpoint.load(Path(told["checkpoint"]), finite=False), told["learning_rate"])
    ranks.tell_all([f"in process {ranks.rank}, {reason}" for reason in why])
    return trainer, told["tree"]["agent"]


def _processes(count: int) -> str:
    return "one process" if count == 1 else f"{count} processes"
