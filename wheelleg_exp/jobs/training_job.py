"""Train, resume, or evaluate in a child process (a job of a sweep, a step of a pipeline): request and both sides."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from wheelleg_exp.child_process import Child, Event, EventPipe, job_events, serve_job
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.job_display import PipeDisplay
from wheelleg_exp.machine import keep_kernels, own_environ
from wheelleg_exp.packages import with_current, without_current
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.stop_request import StopRequest

# The child process imports modules from the same folders as the parent process (``sys.path``).
_BOOT = (
    "import os, sys; sys.path[:] = sys.argv.pop().split(os.pathsep); "
    "from wheelleg_exp.jobs.training_job import main; sys.exit(main())"
)


@dataclass(frozen=True)
class JobRequest:
    """A request to train a new run, or to resume or evaluate an existing run."""

    kind: Literal["train", "resume", "evaluate"]
    overrides: list[str]
    config_dirs: list[str]
    command: list[str]  # The run's manifest records ``command``, a wheelleg command line that does the same job.
    digest: str = ""  # the hash of the training's config, computed when the parent process checked the config
    run: str = ""
    checkpoint: str = ""
    root: str = "runs"  # the root folder of all runs

    def line(self) -> bytes:
        """Return the job request as one line of JSON."""
        return json.dumps(asdict(self)).encode() + b"\n"


def train_request(overrides: Sequence[str], config_dirs: Sequence[Path], digest: str) -> JobRequest:
    """Return the request to train a new run whose config has the hash ``digest``."""
    folders = (word for folder in without_current(config_dirs) for word in ("--config-dir", str(folder)))
    command = ["wheelleg", "train", *overrides, *folders]
    return JobRequest("train", list(overrides), [str(folder) for folder in config_dirs], command, digest)


def resume_request(run: Path, config_dirs: list[str]) -> JobRequest:
    """Return the request to resume the run in a run directory."""
    return JobRequest("resume", [], config_dirs, ["wheelleg", "resume", str(run)], run=str(run))


def job_program(path: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the command that starts a job's child process with the import path ``path`` (default: ``sys.path``)."""
    return (sys.executable, "-P", "-c", _BOOT, os.pathsep.join(sys.path if path is None else path))


def run_request(request: JobRequest, stop: StopRequest) -> AbstractContextManager[Iterator[Event]]:
    """Return a context that runs a job in a child process and yields the job's events (see ``job_events``)."""
    return job_events(Child(job_program(), request.line(), own_environ()), stop)


def main() -> int:
    """Read a job request from standard input, run the job, and return the exit status."""
    return serve_job(serve)


def serve(pipe: EventPipe, line: bytes, stop: StopRequest) -> None:
    """Run the job that ``line``, a line of JSON, describes."""
    request = JobRequest(**json.loads(line))
    {"train": _train, "resume": _resume, "evaluate": _evaluate}[request.kind](pipe, request, stop)


def _train(pipe: EventPipe, request: JobRequest, stop: StopRequest) -> None:
    # A resume calls ``keep_kernels`` before the first import of NumPy, so this module imports no config module.
    from wheelleg_exp.config.checking.find_mistakes import compose_valid
    from wheelleg_exp.config.composing.compose_sweep import digest_of

    folders = with_current([Path(folder) for folder in request.config_dirs])
    composed = compose_valid(request.overrides, config_dirs=folders)
    if digest_of(composed) != request.digest:
        message = "the config files have changed since the sweep was checked"
        raise ConfigError(message, expected="files that do not change until the last job has started")

    from wheelleg_exp.jobs.train.prepare_training import prepare
    from wheelleg_exp.jobs.train.run_training import run
    from wheelleg_exp.lint.physics_check import examine

    stop.check()
    display = PipeDisplay(pipe)
    training = prepare(composed, request.command, display)
    pipe.send("run", path=str(training.directory.path))
    for finding in examine(composed).open:
        display.note(f"warning: {finding.line()}")
    run(training, display, stop)


def _resume(pipe: EventPipe, request: JobRequest, stop: StopRequest) -> None:
    run_directory = RunDirectory.open(request.run, request.root)
    keep_kernels(run_directory.manifest().data.get("environment_variables") or {})

    # Call ``keep_kernels`` before the first import of MKL, which reads its environment variables only once.
    from wheelleg_exp.jobs.train.resume_training import prepare_resume
    from wheelleg_exp.jobs.train.run_training import run

    stop.check()
    display, folders = PipeDisplay(pipe), [Path(folder) for folder in request.config_dirs]
    run(prepare_resume(run_directory, request.overrides, request.command, display, folders), display, stop)


def _evaluate(pipe: EventPipe, request: JobRequest, stop: StopRequest) -> None:
    from wheelleg_exp.jobs.evaluate_policy import evaluate_run

    run, folders = RunDirectory.open(request.run, request.root), [Path(folder) for folder in request.config_dirs]
    words, checkpoint = request.overrides, run.inside(request.checkpoint)
    made = evaluate_run(run, checkpoint, words, request.command, lambda *_: stop.check(), with_current(folders))
    metrics = {name: figure["value"] for name, figure in made.content["metrics"].items()}
    folder, scenarios = made.folder.relative_to(run.path).as_posix(), made.content["scenarios_sha256"]
    pipe.send("evaluated", folder=folder, metrics=metrics, scenarios_sha256=scenarios)


if __name__ == "__main__":
    sys.exit(main())
