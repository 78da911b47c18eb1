"""How the commands that train carry it out, and tell how it ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import print_json
from wheelleg_exp.cli.printing.figures import shown, tool
from wheelleg_exp.errors import EXIT_INTERRUPTED, EXIT_OK, SimulationFailure

if TYPE_CHECKING:
    from wheelleg_exp.jobs.display import Display
    from wheelleg_exp.jobs.stop import StopRequest
    from wheelleg_exp.jobs.train.training import Training
    from wheelleg_exp.run.directory import RunDirectory


def train_on(ready: Training, display: Display, stop: StopRequest) -> dict[str, Any] | None:
    """Train, and say how a training that does not end goes on; return the results, None when it was interrupted."""
    from wheelleg_exp.jobs.train import training
    from wheelleg_exp.run.directory import FAILURE

    try:
        return training.run(ready, display, stop)
    except KeyboardInterrupt:
        found = ready.directory.checkpoints()
        last = f"the last checkpoint is {shown(found[-1])}" if found else "there is no checkpoint yet"
        display.note(f"interrupted; {last}")
        display.note(resume_hint(ready.directory))
        return None
    except SimulationFailure:
        state = ready.directory.path / FAILURE
        if state.is_file():
            display.note(f"what it failed with: {shown(state)}")
        if ready.directory.path.is_dir():
            display.note(resume_hint(ready.directory))
        raise


def resume_hint(directory: RunDirectory) -> str:
    """Return the command that goes on with a run."""
    return f"go on with: {tool('wheelleg')} resume {shown(directory.path)}"


def tell_trained(directory: RunDirectory, results: dict[str, Any] | None, *, as_json: bool) -> int:
    """Say what a training made and what may come next, unless it was interrupted; return the exit status."""
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
    from wheelleg_exp.run.listing import non_finite_note

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
