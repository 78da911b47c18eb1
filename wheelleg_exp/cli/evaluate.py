"""``wheelleg evaluate RUN``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import (
    add_config_dir,
    add_json,
    add_root,
    add_stored,
    chosen_checkpoint,
    offer,
    print_json,
)
from wheelleg_exp.cli.printing.terminal import shown
from wheelleg_exp.errors import EXIT_OK, WheellegError, nearest_name
from wheelleg_exp.terms.key_syntax import is_override

if TYPE_CHECKING:
    from wheelleg_exp.evaluation.protocol import Progress
    from wheelleg_exp.jobs.evaluate_policy import Evaluated
    from wheelleg_exp.run.run_directory import RunDirectory

REFERENCE = "reference"
Policy = tuple["RunDirectory", Path]  # A run and the checkpoint of its policy.


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, 'latest', or a shipped policy: stock:walk"
    offer("run", parser.add_argument("run", metavar="RUN", help=text))
    text = "runs that differ from the first by their seed; and protocol=walk, protocol.walk.episodes=128, or changes "
    text += "of the runs' parameters: env.sim.dt=0.002"
    parser.add_argument("overrides", nargs="*", metavar="RUN|OVERRIDE", help=text)
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="the checkpoint (default: the last one)")
    text = "compare with this run, in pairs of episodes, or with 'reference'; repeatable, once for each seed"
    offer("run", parser.add_argument("--against", metavar="RUN", action="append", default=[], help=text))
    text = "evaluate the linear-quadratic reference controller too"
    parser.add_argument("--reference", action="store_true", help=text)
    text = "simulate with this engine instead of mujoco: physx (docs/engines.md) or warp"
    parser.add_argument("--engine", metavar="NAME", help=text)
    text = "evaluate with each of two engines, and compare them in pairs of episodes: mujoco,physx"
    parser.add_argument("--engines", metavar="NAME,NAME", help=text)
    text = "print only the metrics that match a pattern, such as '*/survival'; repeatable; --json contains all"
    parser.add_argument("--metric", metavar="PATTERN", action="append", default=[], help=text)
    add_stored(parser)
    add_config_dir(parser)
    add_root(parser)
    add_json(parser)


@dataclass(frozen=True)
class Evaluator:
    """Evaluates policies with the settings of a command line; ``stored`` uses evaluations that a run already has."""

    command: list[str]
    config_dirs: list[Path]
    stored: bool
    progress: Progress

    def policy(self, run: RunDirectory, checkpoint: Path, overrides: Sequence[str]) -> Evaluated:
        """Evaluate the policy of a run, or load the run's stored evaluation."""
        from wheelleg_exp.jobs.evaluate_policy import evaluate_run, stored_evaluation

        if self.stored and (made := stored_evaluation(run, checkpoint, overrides, self.config_dirs)) is not None:
            return made
        from wheelleg_exp.inspection.evaluation_plots import draw

        return evaluate_run(run, checkpoint, overrides, self.command, self.progress, self.config_dirs, draw)

    def reference(self, made: Evaluated, overrides: Sequence[str]) -> Evaluated:
        """Evaluate the linear-quadratic reference controller on the robot and task of an evaluated run."""
        from wheelleg_exp.inspection.evaluation_plots import draw
        from wheelleg_exp.jobs.evaluate_policy import evaluate_run

        settings = (self.command, self.progress, self.config_dirs, draw)
        return evaluate_run(made.run, None, overrides, *settings, reference=True)


def run(args: argparse.Namespace) -> int:
    """Evaluate one or several policies, print and store their metrics, and compare the policies with each other."""
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay

    policies, others, overrides, engines = _request(args)
    reference = None
    with ConsoleDisplay(quiet=True) as display:
        evaluator = Evaluator(args.command, args.config_dirs, args.stored, display.test)
        groups = [(policies, overrides), (others, overrides)]
        groups = [(policies, [*overrides, f"env.sim.engine={name}"]) for name in engines] or groups
        made, against = ([evaluator.policy(*one, words) for one in group] for group, words in groups)
        if args.reference or REFERENCE in args.against:
            reference = evaluator.reference(made[0], overrides)
            against = [reference] if REFERENCE in args.against else against
    for name in dict.fromkeys(name for one in (*made, *against) for name in one.noisy):
        override = f"env.observations.{name}.enable_corruption=false"
        print(f"note: the policy observes the noise of its training ({override} switches it off)", file=sys.stderr)
    if len(made) > 1 or against or reference is not None:
        return _compare(made, against, reference, args.command, engines, json=args.json, only=args.metric)
    (one,) = made
    if args.json:
        print_json({"run": str(one.run.path), "folder": str(one.folder), **one.content})
        return EXIT_OK
    from wheelleg_exp.cli.printing.metric_tables import print_evaluation

    print(f"evaluated {shown(one.checkpoint or one.folder)} without exploration noise")
    print_evaluation(one.content, args.metric)
    print(f"\nevaluation: {shown(one.folder)}")
    return EXIT_OK


def _request(args: argparse.Namespace) -> tuple[list[Policy], list[Policy], list[str], tuple[str, ...]]:
    """Return the policies, those of ``--against``, the overrides, and the two engines to compare, if any."""
    names = [args.run, *(word for word in args.overrides if not is_override(word))]
    overrides = [word for word in args.overrides if is_override(word)]
    others = [name for name in args.against if name != REFERENCE]
    if REFERENCE in args.against and others:
        message = "a comparison is either with runs or with the reference"
        raise WheellegError(message, key="--against", expected="runs, or 'reference'")
    for name in others:
        if nearest_name(name, [REFERENCE]) and not Path(name).exists():
            message = f"there is no run '{name}'"
            raise WheellegError(message, key="--against", expected="a run, or 'reference'", nearest=REFERENCE)
    engines = () if args.engines is None else tuple(args.engines.split(","))
    if args.engines is not None and (
        len(set(engines)) != 2 or len(engines) != 2 or args.engine is not None or args.against or args.reference
    ):
        message = f"'{args.engines}' does not name two engines, or another option excludes it"
        expected = "two engines, such as mujoco,physx, without --engine, --against, and --reference"
        raise WheellegError(message, key="--engines", expected=expected)
    chosen, opposite = found(names, args.root, args.checkpoint), found(others, args.root, args.checkpoint)
    _require_one_robot(chosen, "RUN")
    _require_one_robot(opposite, "--against")
    overrides += [] if args.engine is None else [f"env.sim.engine={args.engine}"]
    return chosen, opposite, overrides, engines


def _compare(
    made: Sequence[Evaluated],
    against: Sequence[Evaluated],
    reference: Evaluated | None,
    command: Sequence[str],
    engines: Sequence[str],
    *,
    json: bool,
    only: Sequence[str],
) -> int:
    from wheelleg_exp.cli.printing.metric_tables import print_comparison, print_differences
    from wheelleg_exp.jobs.compare_evaluations import compare

    found = compare(made, against, reference, command, engines=engines)
    if json:
        folders = [str(one.folder) for one in (*made, *against, *([reference] if reference is not None else []))]
        print_json({"folder": str(found.folder), "evaluations": list(dict.fromkeys(folders)), **found.content})
        return EXIT_OK
    print_comparison(found, made, reference, only)
    if against:
        print_differences(found, only)
    print(f"\ncomparison: {shown(found.folder)}")
    return EXIT_OK


def found(names: Sequence[str], root: Path, checkpoint: str | None = None) -> list[Policy]:
    """Return the runs with the given names, each with a checkpoint; raise WheellegError for a repeated name."""
    from wheelleg_exp.run.run_directory import RunDirectory

    runs = [RunDirectory.open(name, root) for name in names]
    for index, directory in enumerate(runs):
        if directory in runs[:index]:
            message = f"run '{directory.id}' is named twice, and would count as two trainings"
            raise WheellegError(message, key="RUN", expected="each run once")
    return [(run, chosen_checkpoint(run, checkpoint)) for run in runs]


def _require_one_robot(chosen: Sequence[Policy], key: str) -> None:
    """Raise WheellegError if runs whose mean is printed were trained with different files of a robot."""
    from wheelleg_exp.run.run_config import recorded_robot

    for run, _ in chosen[1:]:
        if recorded_robot(run).sources != recorded_robot(first := chosen[0][0]).sources:
            message = f"the runs '{first.id}' and '{run.id}' have different robots, so no mean of both is useful"
            raise WheellegError(message, key=key, expected="trainings of one robot with different seeds")
