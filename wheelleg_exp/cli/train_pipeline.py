"""``wheelleg train pipeline=NAME``: train tasks one after the other, with gates between them, or resume a pipeline."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import print_json
from wheelleg_exp.cli.printing.terminal import print_table, shown, tool
from wheelleg_exp.errors import EXIT_FINDING, EXIT_INTERRUPTED, EXIT_OK, ConfigError
from wheelleg_exp.terms.key_syntax import names_pipeline

if TYPE_CHECKING:
    from wheelleg_exp.config.composing.compose import Composed
    from wheelleg_exp.jobs.pipeline.pipeline_settings import PipelineSettings
    from wheelleg_exp.run.run_index import PipelineIndex, PipelineStatus
    from wheelleg_exp.stop_request import StopRequest


def train_pipeline(args: argparse.Namespace, stop: StopRequest) -> int:
    """Compose and check every phase of a pipeline, run the phases, and print the result."""
    if args.multirun:
        raise ConfigError("a pipeline cannot be a job of a sweep", key="-m", expected="one command per pipeline")

    from wheelleg_exp.run.run_index import PipelineIndex

    overrides = [word for word in args.overrides if not names_pipeline(word)]
    pipeline, phases = composed_phases(args.overrides, args.config_dirs)
    stop.check()

    from wheelleg_exp.config.composing.compose_sweep import digest_of

    index = PipelineIndex.create(
        next(iter(phases.values())).config["run"]["root"],
        config=pipeline.tree,
        overrides=overrides,
        config_dirs=args.config_dirs,
        command=args.command,
        digests={name: digest_of(composed) for name, composed in phases.items()},
    )
    return _run(args, index, pipeline, stop)


def composed_phases(words: Sequence[str], config_dirs: Sequence[Path]) -> tuple[PipelineSettings, dict[str, Composed]]:
    """Return a pipeline and the configs of all phases; check that each phase can evaluate the phase's pass condition.

    One ConfigError lists all mistakes that can be found before the first training starts.
    """
    from wheelleg_exp.jobs.pipeline.pipeline_settings import compose_phases, compose_pipeline

    pipeline = compose_pipeline([word for word in words if names_pipeline(word)], config_dirs)
    overrides = [word for word in words if not names_pipeline(word)]
    with nullcontext() if pipeline.composed is None else pipeline.composed.placing():
        phases = compose_phases(pipeline.phases, overrides, config_dirs)

        from wheelleg_exp.jobs.pipeline.run_pipeline import require_metrics

        require_metrics(pipeline.phases, phases, config_dirs)
    return pipeline, phases


def resume_pipeline(args: argparse.Namespace, folder: Path, stop: StopRequest) -> int:
    """Resume a training pipeline at the phase in which the pipeline stopped."""
    from wheelleg_exp.jobs.pipeline.run_pipeline import resume_pipeline as prepare
    from wheelleg_exp.run.run_index import PipelineIndex

    index = PipelineIndex.load(folder)
    return _run(args, index, prepare(index, args.overrides, args.command, args.config_dirs), stop)


def _run(args: argparse.Namespace, index: PipelineIndex, pipeline: PipelineSettings, stop: StopRequest) -> int:
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.errors import WheellegError
    from wheelleg_exp.jobs.pipeline.run_pipeline import PipelineRunner
    from wheelleg_exp.run.run_lock import RunLock

    again = f"{tool('wheelleg')} resume {shown(index.folder)}"
    with ConsoleDisplay(quiet=True) as display, RunLock(index.folder):
        display.note(f"pipeline '{pipeline.tree['name']}': {', '.join(pipeline.phases)}; record: {shown(index.path)}")
        try:
            status = PipelineRunner(index, pipeline, display, stop).run()
        except WheellegError:
            display.note(f"resume with: {again}")
            raise
        if status == "interrupted":
            display.note(f"interrupted; resume with: {again}")
    if args.json:
        print_json({"pipeline": str(index.folder), **index.data})
    elif status != "interrupted":
        _print_result(index, status, again)
    return {"finished": EXIT_OK, "interrupted": EXIT_INTERRUPTED}.get(status, EXIT_FINDING)


def _print_result(index: PipelineIndex, status: PipelineStatus, again: str) -> None:
    rows = []
    for phase in index.phases:
        run = index.run_of(phase)
        rows.append((phase["name"], phase["trained"], phase["status"], phase["why"] or "-", shown(run) if run else "-"))
    print_table(("phase", "iterations", "status", "why", "run"), rows)
    print(f"\npipeline {status}: {shown(index.path)}")
    if status == "finished":
        last = index.run_of(index.phases[-1])
        if last is not None:
            print(f"next: {tool('wheelleg')} play {shown(last)}")
            print(f"      {tool('wheelleg')} evaluate {shown(last)}")
        return
    failed = next(phase for phase in index.phases if phase["status"] == "failed")
    more = 2 * max(int(index.data["config"]["phases"][failed["name"]]["max_iterations"]), int(failed["trained"]))
    print(f"next: {again} pipeline.phases.{failed['name']}.max_iterations={more}")
