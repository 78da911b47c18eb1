"""Building a run again from its own directory, and giving it the state of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.config.changes import Change
from wheelleg_exp.jobs.kept_robot import kept_robot
from wheelleg_exp.jobs.train.training import Recipe
from wheelleg_exp.rl import averaging, digests
from wheelleg_exp.rl.rank_states import of_rank
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.run.directory import RunDirectory


def recipe_of(run: RunDirectory, tree: dict[str, Any], text: str, folders: Sequence[Path]) -> Recipe:
    """Return what a training that goes on is made from.

    Args:
        run: the run.
        tree: its config, with the changes of the resume.
        text: the same as it is kept.
        folders: the user's config folders.
    """
    return Recipe(
        config=tree,
        hydra_files={"config.yaml": text},
        source_roots=(),
        asset=kept_robot(run),
        config_dirs=folders,
        matmul=(run.manifest().data.get("threads") or {}).get("matmul"),
    )


def load(trainer: Trainer, state: Mapping[str, Any], learning_rate: float | None) -> list[str]:
    """Give a training the state of a checkpoint; return what of it is not what was saved, in words.

    Args:
        trainer: of the same networks and environment; of several processes it takes its own part.
        state: the checkpoint's tree.
        learning_rate: what the resume has changed it to, which acts in place of the checkpoint's.
    """
    own = of_rank(state, trainer.ranks.rank)
    trainer.load_state_dict(own)
    if learning_rate is not None:
        trainer.set_learning_rate(learning_rate)
    wanted = digests.of_state(own if trainer.average.is_on else averaging.without(own))
    found = digests.of_state(trainer.state_dict())
    lost = [name for name in wanted if wanted[name] != found.get(name)]
    return [f"the {', '.join(lost)} after loading are not what was saved"] if lost else []


def learning_rate_of(changes: Sequence[Change]) -> float | None:
    """Return the learning rate that a resume sets; None where it changes none."""
    found = [change.b for change in changes if change.keys == ("agent", "algorithm", "learning_rate")]
    return float(found[-1]) if found else None
