"""One step of a pipeline, in a process of its own (see ``processes``): to train a phase, go on with it, or judge it."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from wheelleg_exp.jobs import sweep_job as one_training
from wheelleg_exp.jobs.processes import Events, serve
from wheelleg_exp.stop_request import StopRequest


@dataclass(frozen=True)
class Step:
    """What is done.

    Attributes:
        kind: train a new run, go on with one, or evaluate one.
        overrides: of the training, the resume or the protocol.
        config_dirs: the user's config folders.
        command: the command line, for the manifest.
        digest: of the config that was checked, for a training.
        run: the run, but for a training.
        checkpoint: the name of the checkpoint that is evaluated.
    """

    kind: Literal["train", "resume", "evaluate"]
    overrides: list[str]
    config_dirs: list[str]
    command: list[str]
    digest: str = ""
    run: str = ""
    checkpoint: str = ""
    root: str = field(default="runs")

    def line(self) -> bytes:
        """Return the step as one line."""
        return json.dumps(asdict(self)).encode() + b"\n"


def main() -> int:
    """Do what the first line of standard input asks for, and return the exit status."""
    return serve(lambda descriptor, _: Events(descriptor), _do)


def _do(events: Events, line: bytes, stop: StopRequest) -> None:
    step = Step(**json.loads(line))
    if step.kind == "train":
        request = one_training.Request(step.overrides, step.config_dirs, step.command, step.digest)
        one_training.train(events, request.line(), stop)
    elif step.kind == "resume":
        _resume(events, step, stop)
    else:
        _evaluate(events, step, stop)


def _resume(events: Events, step: Step, stop: StopRequest) -> None:
    from wheelleg_exp.machine import keep_kernels
    from wheelleg_exp.run.run_directory import RunDirectory

    run = RunDirectory.open(step.run, step.root)
    keep_kernels(run.manifest().data.get("environment_variables") or {})

    from wheelleg_exp.jobs.train import resume_training, run_training

    stop.check()
    ready = resume_training.prepare_resume(
        run, step.overrides, step.command, events, [Path(folder) for folder in step.config_dirs]
    )
    run_training.run(ready, events, stop)


def _evaluate(events: Events, step: Step, stop: StopRequest) -> None:
    from wheelleg_exp.jobs.evaluate_policy import evaluate_run
    from wheelleg_exp.packages import with_current
    from wheelleg_exp.run.run_directory import RunDirectory

    run = RunDirectory.open(step.run, step.root)

    def tell(_test: str, _done: int, _total: int) -> None:
        stop.check()

    folders = with_current([Path(folder) for folder in step.config_dirs])
    made = evaluate_run(run, run.inside(step.checkpoint), step.overrides, step.command, tell, folders)
    events.send(
        "evaluated",
        folder=made.folder.relative_to(run.path).as_posix(),
        metrics={name: figure["value"] for name, figure in made.content["metrics"].items()},
        scenarios_sha256=made.content["scenarios_sha256"],
    )


if __name__ == "__main__":
    sys.exit(main())
