"""Define the command ``wheelleg train``, and print the results for all commands that train."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_json, add_overrides, print_json, together
from wheelleg_exp.cli.printing.terminal import hanging, shown, tool
from wheelleg_exp.errors import EXIT_INTERRUPTED, EXIT_OK, SimulationFailure
from wheelleg_exp.torchrun import require_alone, world_size

if TYPE_CHECKING:
    from wheelleg_exp.config.composing.compose import Composed
    from wheelleg_exp.jobs.job_display import Display
    from wheelleg_exp.jobs.train.prepare_training import Training
    from wheelleg_exp.rl.ranks import Ranks
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.stop_request import StopRequest


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    add_json(parser)
    text = "train every combination of several values: seed=1,2,3 env.rewards.alive.weight=choice(1,2) "
    text += "[hydra/launcher=joblib hydra.launcher.n_jobs=2]"
    parser.add_argument("-m", "--multirun", action="store_true", help=text)


def run(args: argparse.Namespace) -> int:
    """Train one run, a sweep, or a pipeline, and print the result of the training."""
    from wheelleg_exp.stop_request import StopRequest
    from wheelleg_exp.terms.key_syntax import names_pipeline

    # Handle interrupts before heavy imports, because an interrupt can be lost while Python imports a C++ library.
    with StopRequest() as stop:
        if any(map(names_pipeline, args.overrides)):
            from wheelleg_exp.cli.train_pipeline import train_pipeline

            require_alone("pipeline")
            return train_pipeline(args, stop)
        if args.multirun:
            from wheelleg_exp.cli.train_sweep import train_all

            require_alone("--multirun")
            return train_all(args, stop)
        return together(train_one, _follow, args, stop) if world_size() > 1 else train_one(args, stop)


def train_one(args: argparse.Namespace, stop: StopRequest, ranks: Ranks | None = None) -> int:
    """Train one run in this process, which is the process with rank 0 if the training uses several processes."""
    from wheelleg_exp.config.checking.find_mistakes import compose_valid

    with ranks.agreed() if ranks else nullcontext():
        composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.train.prepare_training import prepare
    from wheelleg_exp.lint.physics_check import examine
    from wheelleg_exp.rl.ranks import ALONE

    with ConsoleDisplay() as display:
        stop.check(ranks.any(stop.requested) if ranks else None)
        if ranks:
            ranks.require_equal(_digests(composed))
        ready = prepare(composed, args.command, display, ranks or ALONE)
        directory = ready.directory
        display.note(f"run directory: {shown(directory.path)}")
        for finding in examine(composed).open:
            display.note(hanging(f"warning: {finding.line()}", 4))
        results = train_on(ready, display, stop)
    return print_trained(directory, results, as_json=args.json)


def _follow(args: argparse.Namespace, stop: StopRequest, ranks: Ranks) -> None:
    """Take part in the training of one run as a process whose rank is not 0."""
    from wheelleg_exp.config.checking.find_mistakes import compose_valid

    with ranks.agreed():
        composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.jobs.train.prepare_training import prepare_other_rank
    from wheelleg_exp.jobs.train.run_training import run_other_rank

    stop.check(ranks.any(stop.requested))
    ranks.require_equal(_digests(composed))
    run_other_rank(*prepare_other_rank(composed, ranks), stop)


def _digests(composed: Composed) -> dict[str, str]:
    from wheelleg_exp.config.composing.compose_sweep import digest_of

    return {"the composed config": digest_of(composed)}


def train_on(ready: Training, display: Display, stop: StopRequest) -> dict[str, object] | None:
    """Train a prepared run and return the results; after an interrupt, print a resume command and return None."""
    from wheelleg_exp.jobs.train.run_training import run
    from wheelleg_exp.run.run_directory import FAILURE

    try:
        return run(ready, display, stop)
    except KeyboardInterrupt:
        found = ready.directory.checkpoints()
        last = f"the last checkpoint is {shown(found[-1])}" if found else "there is no checkpoint yet"
        display.note(f"interrupted; {last}")
        display.note(resume_hint(ready.directory))
        return None
    except SimulationFailure:
        state = ready.directory.path / FAILURE
        if state.is_file():
            display.note(f"state at the failure: {shown(state)}")
        if ready.directory.path.is_dir():
            display.note(resume_hint(ready.directory))
        raise


def resume_hint(directory: RunDirectory) -> str:
    """Return a line of text with the command that resumes a run."""
    return f"resume with: {tool('wheelleg')} resume {shown(directory.path)}"


def print_trained(directory: RunDirectory, results: dict[str, object] | None, *, as_json: bool) -> int:
    """Print the results of a training that was not interrupted, and useful next commands; return the exit status."""
    if results is None:
        return EXIT_INTERRUPTED
    if as_json:
        facts = directory.manifest().data
        last = facts["resumes"][-1] if facts["resumes"] else None
        document = {"run": str(directory.path), "status": "finished", "results": results}
        if last is not None:
            document["resume"] = {key: last.get(key) for key in ("iteration", "overrides", "exact", "why", "proved")}
        print_json(document)
        return EXIT_OK
    from wheelleg_exp.run.run_list import non_finite_note

    path = shown(directory.path)
    print(f"trained {results['iterations']} iterations in {results['seconds']:.0f} s: {path}")
    if note := non_finite_note(results):
        print(f"warning: {note}")
    print(f"next: {tool('wheelleg')} play {path}")
    if list(directory.path.glob("events.out.tfevents.*")):
        print(f"      {tool('tensorboard')} --logdir {path}")
    if directory.recording.is_file():
        print(f"      {tool('rerun')} {path}/recording.rrd")
    return EXIT_OK
