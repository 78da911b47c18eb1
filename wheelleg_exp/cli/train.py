"""``wheelleg train``: train a run, a sweep, or a pipeline, and print the results of all commands that train."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_json, add_overrides, print_json, together
from wheelleg_exp.cli.printing.terminal import hanging, print_table, shown, tool
from wheelleg_exp.errors import (
    EXIT_FAILED,
    EXIT_FINDING,
    EXIT_INTERRUPTED,
    EXIT_OK,
    ConfigError,
    Interrupted,
    SimulationFailure,
    WheellegError,
)
from wheelleg_exp.files import read_json, write_text
from wheelleg_exp.packages import without_current
from wheelleg_exp.terms.key_syntax import names_pipeline
from wheelleg_exp.torchrun import require_alone, world_size

if TYPE_CHECKING:
    from wheelleg_exp.config.composing.compose import Composed
    from wheelleg_exp.config.composing.compose_sweep import Sweep
    from wheelleg_exp.jobs.job_display import Display
    from wheelleg_exp.jobs.pipeline.run_pipeline import PipelineSettings
    from wheelleg_exp.jobs.run_sweep import SweepDisplay
    from wheelleg_exp.jobs.train.prepare_training import Training
    from wheelleg_exp.jobs.training_job import JobRequest
    from wheelleg_exp.rl.ranks import Ranks
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.run.run_index import PipelineIndex, SweepIndex, SweepStatus
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
            require_alone("pipeline")
            return train_pipeline(args, stop)
        if args.multirun:
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


_STATUS = {"finished": EXIT_OK, "failed": EXIT_FAILED, "interrupted": EXIT_INTERRUPTED}


def train_all(args: argparse.Namespace, stop: StopRequest) -> int:
    """Expand a sweep into jobs, check and train every job, and print the results."""
    from wheelleg_exp.cli.printing.progress_display import ConsoleSweepDisplay
    from wheelleg_exp.config.composing.compose_sweep import compose_sweep

    with ConsoleSweepDisplay() as display:

        def progress(done: int, total: int) -> None:
            stop.check()
            display.checking(done, total)

        sweep = compose_sweep(args.overrides, config_dirs=args.config_dirs, progress=progress)
        display.checked()

        from omegaconf import OmegaConf

        from wheelleg_exp.jobs.training_job import train_request
        from wheelleg_exp.run.run_index import MULTIRUN_NAME, SweepIndex
        from wheelleg_exp.run.run_lock import RunLock

        at_once = _at_once(sweep)
        root, facts = sweep.jobs[0].config["run"]["root"], {"name": sweep.launcher, "at_once": at_once}
        entries = [(job.overrides, job.swept) for job in sweep.jobs]
        index = SweepIndex.create(root, command=args.command, launcher=facts, jobs=entries)
        sweep.multirun.hydra.sweep.dir = str(index.folder)
        write_text(index.folder / MULTIRUN_NAME, OmegaConf.to_yaml(sweep.multirun))
        display.say(f"jobs: {len(sweep.jobs)}, {at_once} at a time; index: {shown(index.path)}")
        crowded = _crowded(sweep, at_once)
        if crowded:
            display.say(f"warning: {crowded}")
        requests = [train_request(job.overrides, args.config_dirs, job.digest) for job in sweep.jobs]
        with RunLock(index.folder):
            status = _run_sweep(index, sweep, requests, display, stop)
    return _print_sweep(args, index, status)


def _run_sweep(
    index: SweepIndex, sweep: Sweep, requests: Sequence[JobRequest], display: SweepDisplay, stop: StopRequest
) -> SweepStatus:
    """Run the unfinished jobs of a sweep's index with the sweep's launcher; the caller has the lock of the sweep."""
    from wheelleg_exp.jobs.run_sweep import SweepRunner, make_launcher

    index.restart()
    try:
        settings = sweep.settings(index.folder)
        launcher = make_launcher(sweep.launcher, settings, index.folder) if requests else None
    except WheellegError:
        index.finish("failed")
        raise
    return SweepRunner(index, requests, index.data["launcher"]["at_once"], display, stop, launcher).run()


def _print_sweep(args: argparse.Namespace, index: SweepIndex, status: SweepStatus) -> int:
    if args.json:
        jobs = [{**job, "run": None if job["run"] is None else str(index.run_of(job))} for job in index.jobs]
        print_json({"sweep": str(index.folder), **index.data, "jobs": jobs})
    else:
        _print_report(index, without_current(args.config_dirs))
    return _STATUS[status]


def resume_sweep(args: argparse.Namespace, stop: StopRequest) -> int:
    """Resume the unfinished runs of a sweep, train the jobs without a run, and print the results of all jobs."""
    from wheelleg_exp.run.run_list import open_sweep

    if args.overrides:
        where, expected = f"override {args.overrides[0]}", "'wheelleg resume RUN' with overrides"
        raise ConfigError("a resumed sweep accepts no overrides", where=where, expected=expected)
    index = open_sweep(args.run, Path(args.root))
    index.require_ended()

    from wheelleg_exp.cli.printing.progress_display import ConsoleSweepDisplay
    from wheelleg_exp.jobs.run_sweep import recorded_sweep, remaining_requests
    from wheelleg_exp.run.run_index import SweepIndex
    from wheelleg_exp.run.run_lock import RunLock

    with RunLock(index.folder), ConsoleSweepDisplay() as display:
        index = SweepIndex.load(index.folder)  # Another resume can have ended since the first read.
        requests, sweep = remaining_requests(index, args.config_dirs), recorded_sweep(index)
        display.say(f"jobs to resume: {len(requests)} of {len(index.jobs)}; index: {shown(index.path)}")
        status = _run_sweep(index, sweep, requests, display, stop)
    return _print_sweep(args, index, status)


def _at_once(sweep: Sweep) -> int:
    from wheelleg_exp.config.composing.compose_sweep import QUEUES

    if sweep.launcher in QUEUES:
        return sweep.n_jobs
    return min(len(sweep.jobs), int(_joblib().effective_n_jobs(sweep.n_jobs)))


def _joblib() -> ModuleType:
    """Import joblib, and unset the environment variables that joblib sets, because sweep jobs would inherit them."""
    before = set(os.environ)
    joblib = import_module("joblib")
    for name in set(os.environ) - before:
        del os.environ[name]
    return joblib


def _crowded(sweep: Sweep, at_once: int) -> str | None:
    """Return a warning if the sweep jobs on this machine use more threads than the machine has cores."""
    from wheelleg_exp.config.composing.compose_sweep import QUEUES

    # A job queue such as Slurm runs a sweep's jobs on other machines, or limits the number of cores for each job.
    if sweep.launcher in QUEUES and sweep.launcher != "submitit_local":
        return None
    cores = int(_joblib().cpu_count())
    configs = [job.config for job in sweep.jobs]
    threads = max(max(c["agent"]["torch_threads"], c["env"]["sim"]["nthread"] or cores) for c in configs)
    if at_once == 1 or at_once * threads <= cores:
        return None
    each = max(1, cores // at_once)
    text = f"{at_once} jobs of {threads} threads each share {cores} cores; agent.torch_threads={each} "
    return text + f"env.sim.nthread={each} is faster and gives the same numbers"


def _print_report(index: SweepIndex, config_dirs: Sequence[Path]) -> None:
    rows = []
    for job in index.jobs:
        run, reward = index.run_of(job), job["results"].get("Train/mean_reward")
        status = "not started" if job["status"] == "waiting" else job["status"]
        figure = f"{reward:.3f}" if isinstance(reward, float) else "-"
        rows.append((job["number"], " ".join(job["swept"]) or "-", status, figure, shown(run) if run else "-"))
    print_table(("job", "overrides", "status", "return", "run"), rows)
    done = [job for job in index.jobs if job["status"] == "finished"]
    print(f"\n{len(done)} of {len(index.jobs)} jobs finished: {shown(index.path)}")
    program = tool("wheelleg")
    runs = [shown(run) for job in done if (run := index.run_of(job)) is not None]
    following = []
    if runs:
        following.append([tool("tensorboard"), "--logdir", os.path.commonpath([Path(run).parent for run in runs])])
        following += [[program, "diff", *runs[:2]]] if len(runs) > 1 else []
        following.append([program, "play", runs[0]])
    for number, words in enumerate(following):
        print(f"{'' if number else 'next:':<6} {shlex.join(words)}")
    if index.unfinished():
        folders = [word for folder in config_dirs for word in ("--config-dir", str(folder))]
        print("retry:", shlex.join([program, "resume", "--sweep", shown(index.folder), *folders]))


def train_pipeline(args: argparse.Namespace, stop: StopRequest) -> int:
    """Compose and check every phase of a pipeline, run the phases, and print the result."""
    if args.multirun:
        raise ConfigError("a pipeline cannot be a job of a sweep", key="-m", expected="one command per pipeline")

    from wheelleg_exp.run.run_index import PipelineIndex

    overrides = [word for word in args.overrides if not names_pipeline(word)]
    pipeline, phases = composed_phases(args.overrides, args.config_dirs)
    _require_own_robot(pipeline, phases, args)
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
    return _run_pipeline(args, index, pipeline, stop)


def _require_own_robot(pipeline: PipelineSettings, phases: Mapping[str, Composed], args: argparse.Namespace) -> None:
    """Raise ConfigError if the user's project has robots, and a phase trains another one that nobody named."""
    own = sorted({file.stem for folder in args.config_dirs for file in (folder / "robot").glob("*.yaml")})
    for name, composed in phases.items():
        robot, words = composed.hydra.runtime.choices.get("robot"), [*args.overrides, *pipeline.phases[name].overrides]
        if own and robot not in {None, *own} and not any(word.startswith("robot=") for word in words):
            message = f"phase '{name}' trains the robot '{robot}', which is not a robot of this project"
            expected = " or ".join(f"robot={one}" for one in [*own, robot])
            raise ConfigError(message, key="robot", expected=expected)


def composed_phases(words: Sequence[str], config_dirs: Sequence[Path]) -> tuple[PipelineSettings, dict[str, Composed]]:
    """Return a pipeline and the configs of all phases; check that each phase can evaluate the phase's pass condition.

    ``words`` contains the config overrides of a training pipeline and of all trainings that the pipeline starts. A
    ConfigError from ``composed_phases`` lists all config mistakes that can be found before the first training starts.
    """
    from wheelleg_exp.jobs.pipeline.run_pipeline import compose_phases, compose_pipeline

    pipeline = compose_pipeline([word for word in words if names_pipeline(word)], config_dirs)
    overrides = [word for word in words if not names_pipeline(word)]
    with nullcontext() if pipeline.composed is None else pipeline.composed.placing():
        phases = compose_phases(pipeline.phases, overrides, config_dirs)

        from wheelleg_exp.jobs.pipeline.run_pipeline import require_figures, require_metrics

        require_metrics(pipeline.phases, phases, config_dirs)
        require_figures(pipeline, list(phases.values())[-1], config_dirs)
    return pipeline, phases


def resume_pipeline(args: argparse.Namespace, folder: Path, stop: StopRequest) -> int:
    """Resume a training pipeline at the phase in which the pipeline stopped."""
    from wheelleg_exp.jobs.pipeline.run_pipeline import resume_pipeline as prepare
    from wheelleg_exp.run.run_index import PipelineIndex

    index = PipelineIndex.load(folder)
    return _run_pipeline(args, index, prepare(index, args.overrides, args.command, args.config_dirs), stop)


def _present(run: Path, film: Path, pipeline: PipelineSettings, config_dirs: Sequence[str]) -> list[str]:
    """Evaluate, film, export, and describe the last policy of a pipeline with the commands that a user would type.

    Return the failed commands, and a message if the robot falls in the film. Raise Interrupted if one was interrupted.
    """
    words = [word for folder in config_dirs for word in ("--config-dir", folder)]
    words += [word for pattern in pipeline.tree.get("figures", []) for word in ("--metric", pattern)]
    failed = [
        *_command("evaluate", str(run), f"protocol={pipeline.results}", "--reference", *words),
        *_command("play", str(run), "env.num_envs=1", "env.episode_length_s=20.0"),
    ]
    for recording in sorted((run / "play").glob("*/recording.rrd"))[-1:]:
        failed += _command("inspect", str(recording), "--video", str(film))
        if read_json(recording.with_name("figures.json")).get("survival") == 0.0:
            failed.append(f"the robot falls in the film: {shown(film)}")
    return [*failed, *_command("export", str(run)), *_command("report", str(run))]


def _command(*words: str) -> list[str]:
    """Run a command of this program; return it if it failed, or nothing. Raise Interrupted if it was interrupted."""
    from wheelleg_exp.cli.main import main

    text = shlex.join(["wheelleg", *words])
    print(f"\n$ {text}", file=sys.stderr)
    with redirect_stdout(sys.stderr):  # The standard output contains only the result of the pipeline.
        status = main(words)
    if status == EXIT_INTERRUPTED:
        raise Interrupted
    return [] if status == EXIT_OK else [text]


def _run_pipeline(args: argparse.Namespace, index: PipelineIndex, pipeline: PipelineSettings, stop: StopRequest) -> int:
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.errors import WheellegError
    from wheelleg_exp.jobs.pipeline.run_pipeline import PipelineRunner, phase_overrides
    from wheelleg_exp.run.run_lock import RunLock

    again = f"{tool('wheelleg')} resume {shown(index.folder)}"
    with ConsoleDisplay(quiet=True) as display, RunLock(index.folder):
        asked = shlex.join([f"pipeline={pipeline.tree['name']}", *index.data["overrides"]])
        display.note(f"{asked}: {', '.join(pipeline.phases)}; record: {shown(index.path)}")
        try:
            status = PipelineRunner(index, pipeline, display, stop).run()
        except WheellegError:
            display.note(f"resume with: {again}")
            raise
        if status == "interrupted":
            display.note(f"interrupted; resume with: {again}")
    last, undone = index.run_of(index.phases[-1]), list[str]()
    failed = [entry for entry in index.phases if entry["status"] == "failed"]
    for entry in failed if status == "stopped" else ():
        words = phase_overrides(entry["name"], pipeline.phases[entry["name"]], index.data["overrides"])
        folders = [word for folder in index.data["config_dirs"] for word in ("--config-dir", folder)]
        _command("doctor", *words, "--all", *folders)  # Findings that the config accepts can be the cause, too.
    if status == "finished" and pipeline.results is not None and last is not None:
        undone = _present(last, index.folder / "film.mp4", pipeline, index.data["config_dirs"])
    done = EXIT_FINDING if undone else EXIT_OK
    if args.json:
        print_json({"pipeline": str(index.folder), **index.data})
        return {"finished": done, "interrupted": EXIT_INTERRUPTED}.get(status, EXIT_FINDING)
    if status == "interrupted":
        return EXIT_INTERRUPTED
    rows = []
    for phase in index.phases:
        run = index.run_of(phase)
        rows.append((phase["name"], phase["trained"], phase["status"], phase["why"] or "-", shown(run) if run else "-"))
    print_table(("phase", "iterations", "status", "why", "run"), rows)
    print(f"\npipeline {status}: {shown(index.path)}")
    if status == "finished":
        if last is not None:
            print(f"next: {tool('wheelleg')} play {shown(last)} --drive")
            print(f"      {tool('wheelleg')} evaluate {shown(last)}")
        for text in undone:
            print(f"failed: {text}")
        return done
    first = failed[0]
    more = 2 * max(int(index.data["config"]["phases"][first["name"]]["max_iterations"]), int(first["trained"]))
    print(f"next: {again} pipeline.phases.{first['name']}.max_iterations={more}")
    return EXIT_FINDING
