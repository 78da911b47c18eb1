"""``wheelleg evaluate RUN``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_config_dir, add_json, add_root, chosen_checkpoint, print_json
from wheelleg_exp.cli.printing.terminal import shown
from wheelleg_exp.errors import EXIT_OK, WheellegError, nearest_name
from wheelleg_exp.terms.key_syntax import is_override

if TYPE_CHECKING:
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.evaluate_policy import Evaluated
    from wheelleg_exp.run.run_directory import RunDirectory

REFERENCE = "reference"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", metavar="RUN", help="a run directory, its id, 'latest', or a shipped policy: stock:walk")
    text = "runs that differ from the first by their seed; and protocol=walk, protocol.walk.episodes=128, or changes "
    text += "of the runs' parameters: env.sim.dt=0.002"
    parser.add_argument("overrides", nargs="*", metavar="RUN|OVERRIDE", help=text)
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="the checkpoint (default: the last one)")
    text = "compare with this run, in pairs of episodes, or with 'reference'; repeatable, once for each seed"
    parser.add_argument("--against", metavar="RUN", action="append", default=[], help=text)
    text = "evaluate the linear-quadratic reference controller too"
    parser.add_argument("--reference", action="store_true", help=text)
    text = "simulate with this engine instead of mujoco: physx (docs/engines.md) or warp"
    parser.add_argument("--engine", metavar="NAME", help=text)
    text = "evaluate with each of two engines, and compare them in pairs of episodes: mujoco,physx"
    parser.add_argument("--engines", metavar="NAME,NAME", help=text)
    text = "use a run's stored evaluation of this protocol, and evaluate only the other runs"
    parser.add_argument("--kept", action="store_true", help=text)
    add_config_dir(parser)
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate one or several policies, print and store their metrics, and compare the policies with each other."""
    from wheelleg_exp.cli.printing.metric_tables import print_evaluation
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay

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
    engines = _engines(args)
    chosen, opposite = found(args, names), found(args, others)
    _require_one_robot(chosen, "RUN")
    _require_one_robot(opposite, "--against")
    with ConsoleDisplay(quiet=True) as display:
        if len(engines) == 2:
            first, second = ([evaluated(args, *one, [*overrides, w], display) for one in chosen] for w in engines)
            return _compare(args, first, second, None, args.engines.split(","))
        overrides += engines
        made = [evaluated(args, *one, overrides, display) for one in chosen]
        against = [evaluated(args, *one, overrides, display) for one in opposite]
        reference = None
        if args.reference or REFERENCE in args.against:
            reference = reference_of(args, made[0], overrides, display)
            against = [reference] if REFERENCE in args.against else against
    if len(made) > 1 or against or reference is not None:
        return _compare(args, made, against, reference)
    (one,) = made
    if args.json:
        print_json({"run": str(one.run.path), "folder": str(one.folder), **one.content})
        return EXIT_OK
    print(f"evaluated {shown(one.checkpoint or one.folder)} without exploration noise")
    print_evaluation(one.content)
    print(f"\nevaluation: {shown(one.folder)}")
    return EXIT_OK


def _engines(args: argparse.Namespace) -> list[str]:
    """Return the overrides that select the engines of ``--engine`` or ``--engines``: none, one, or two."""
    if args.engines is None:
        return [] if args.engine is None else [f"env.sim.engine={args.engine}"]
    names = args.engines.split(",")
    if len(set(names)) != 2 or args.engine is not None or args.against or args.reference:
        message = f"'{args.engines}' does not name two engines, or another option excludes it"
        expected = "two engines, such as mujoco,physx, without --engine, --against, and --reference"
        raise WheellegError(message, key="--engines", expected=expected)
    return [f"env.sim.engine={name}" for name in names]


def _compare(
    args: argparse.Namespace,
    made: Sequence[Evaluated],
    against: Sequence[Evaluated],
    reference: Evaluated | None,
    engines: Sequence[str] = (),
) -> int:
    from wheelleg_exp.cli.printing.metric_tables import print_comparison, print_differences
    from wheelleg_exp.jobs.evaluate_policy import compare

    found = compare(made, against, reference, args.command, engines=engines)
    if args.json:
        folders = [str(one.folder) for one in (*made, *against, *([reference] if reference is not None else []))]
        print_json({"folder": str(found.folder), "evaluations": list(dict.fromkeys(folders)), **found.content})
        return EXIT_OK
    print_comparison(found, made, reference)
    if against:
        print_differences(found)
    print(f"\ncomparison: {shown(found.folder)}")
    return EXIT_OK


def found(args: argparse.Namespace, names: Sequence[str]) -> list[tuple[RunDirectory, Path]]:
    """Return the runs with the given names, each with a checkpoint; raise WheellegError for a repeated name."""
    from wheelleg_exp.run.run_directory import RunDirectory

    asked, runs = getattr(args, "checkpoint", None), [RunDirectory.open(name, args.root) for name in names]
    for index, directory in enumerate(runs):
        if directory in runs[:index]:
            message = f"run '{directory.id}' is named twice, and would count as two trainings"
            raise WheellegError(message, key="RUN", expected="each run once")
    return [(run, chosen_checkpoint(run, asked)) for run in runs]


def _require_one_robot(chosen: Sequence[tuple[RunDirectory, Path]], key: str) -> None:
    """Raise WheellegError if runs whose mean is printed were trained with different files of a robot."""
    from wheelleg_exp.jobs.saved_robot import saved_sources

    for run, _ in chosen[1:]:
        if saved_sources(run) != saved_sources(first := chosen[0][0]):
            message = f"the runs '{first.id}' and '{run.id}' have different robots, so no mean of both is useful"
            raise WheellegError(message, key=key, expected="trainings of one robot with different seeds")


def evaluated(
    args: argparse.Namespace, run: RunDirectory, checkpoint: Path, overrides: Sequence[str], display: ConsoleDisplay
) -> Evaluated:
    """Evaluate the policy of one run, or load the run's stored evaluation if the option ``--kept`` is given."""
    from wheelleg_exp.jobs import evaluate_policy as jobs

    if args.kept:
        from wheelleg_exp.files import sha256

        tree = jobs.evaluation_settings(run, overrides, args.config_dirs)
        folder = jobs.find_saved(run, sha256(checkpoint), tree, overrides)
        if folder is not None:
            found, content = jobs.read_evaluation(folder), jobs.read_content(folder)
            return jobs.Evaluated(run, checkpoint, folder, found, content)
    from wheelleg_exp.inspection.evaluation_plots import draw

    return jobs.evaluate_run(run, checkpoint, overrides, args.command, display.test, args.config_dirs, draw)


def reference_of(
    args: argparse.Namespace, made: Evaluated, overrides: Sequence[str], display: ConsoleDisplay
) -> Evaluated:
    """Evaluate the linear-quadratic reference controller on the robot and task of an evaluated run."""
    from wheelleg_exp.inspection.evaluation_plots import draw
    from wheelleg_exp.jobs.evaluate_policy import evaluate_reference

    return evaluate_reference(made.run, overrides, args.command, display.test, args.config_dirs, draw)
