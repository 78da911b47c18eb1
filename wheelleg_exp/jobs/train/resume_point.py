"""Find the last complete checkpoint of a run, and remove the data of later iterations from the run's files."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import cut, for_people, temporaries
from wheelleg_exp.jobs.rollout_files import dataset_files_from
from wheelleg_exp.jobs.train.scalar_logs import cut_events
from wheelleg_exp.jobs.train.training_recording import films_from
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import IterationLog, Line, LogLine, comparable_digests, read_log
from wheelleg_exp.run.manifest import SNAPSHOT, Manifest
from wheelleg_exp.run.run_directory import CHECKPOINT, FAILURE, RunDirectory, checkpoint_iteration
from wheelleg_exp.run.run_list import effective_status
from wheelleg_exp.verify.check_files import Subject, damage

_CONTINUED_FILES = ("iterations.jsonl", "recording.rrd")


@dataclass(frozen=True)
class ResumePoint:
    """The point from which a run resumes: the end of the last iteration that has a complete checkpoint."""

    iteration: int  # the first training iteration that the resume computes
    checkpoint: Path | None  # the checkpoint from which the run resumes; None if the run restarts at iteration 0
    state: Mapping[str, object] | None
    lines: Sequence[Line]  # the complete lines in the run's iteration log
    damaged: Mapping[Path, str]  # maps each damaged checkpoint after ``iteration`` to a text about the damage

    @property
    def earlier_lines(self) -> list[LogLine]:
        """The lines in the run's iteration log up to the checkpoint."""
        return [line.content for line in self.lines[: self.iteration]]

    def dropped(self, until: int) -> dict[int, Mapping[str, str]]:
        """Return the logged digests (hashes) of the iterations, up to ``until - 1``, that the resume repeats."""
        later = self.lines[self.iteration : until]
        return {line.iteration: found for line in later if (found := comparable_digests(line, digests.FORMAT))}


def find_point(run: RunDirectory) -> ResumePoint:
    """Find a run's last checkpoint that matches its iteration log; RunDirectoryError if none can be used."""
    lines = read_log(run.iterations).lines
    damaged: dict[Path, str] = {}
    foreign: RunDirectoryError | None = None
    for path in reversed(run.checkpoints()):
        try:
            state = checkpoint.load(path, finite=False)  # Accept a checkpoint with NaN; the training detects NaN.
            if state["iter"] != checkpoint_iteration(path):
                message = f"the checkpoint's iteration {state['iter']} differs from its file name"
                raise RunDirectoryError(message, key=str(path))
        except RunDirectoryError as error:
            damaged[path] = error.message
            continue
        checkpoint.require_resumable(state)
        point = ResumePoint(checkpoint_iteration(path) + 1, path, state, lines, damaged)
        if len(point.lines) < point.iteration:
            raise RunDirectoryError(
                f"{run.iterations.name} has no complete line of iteration {len(point.lines)}, but the checkpoint "
                f"{path.name} exists",
                key=str(run.iterations),
                expected=f"a line for each iteration up to {point.iteration - 1}; or no checkpoint from "
                f"model_{len(point.lines)}.pt on, to resume from an earlier one",
            )
        logged = comparable_digests(lines[point.iteration - 1], digests.format_of(state))
        stored = digests.of_state(state) if logged else {}
        wrong = [name for name, digest in logged.items() if stored.get(name, digest) != digest]
        if not wrong:
            return point
        verb = "differ" if len(wrong) > 1 or wrong[0].endswith("s") else "differs"
        damaged[path] = f"{', '.join(wrong)} {verb} from the logged digests of iteration {point.iteration - 1}"
        why = f"no checkpoint belongs to the training in {run.iterations.name}: {damaged[path]}"
        own = "the run's own checkpoints and log"
        foreign = foreign or RunDirectoryError(why, key=str(path), expected=own)
    if foreign is not None:  # A restart at iteration 0 would discard the finished training iterations.
        raise foreign
    return ResumePoint(0, None, None, lines, damaged)


def lasting_damage(run: RunDirectory, manifest: Manifest, point: ResumePoint) -> list[str]:
    """Return texts about damaged files of a run that a resume will not replace."""
    found = []
    for name, what in damage(Subject(run, manifest, effective_status(manifest), IterationLog())).items():
        saved, is_continued = CHECKPOINT.fullmatch(name), point.iteration > 0 and name in _CONTINUED_FILES
        lasts = int(saved[1]) < point.iteration if saved else name == MANIFEST_NAME or name.startswith(SNAPSHOT)
        found += [f"{name} {what}"] if lasts or is_continued else []
    return found


_DAMAGED = ".damaged"


def drop_past_checkpoint(run: RunDirectory, point: ResumePoint, *, events: bool) -> None:
    """Remove data after the checkpoint and of killed processes; ``events`` also cuts TensorBoard's event files."""
    for path in point.damaged:
        with for_people(path):
            path.replace(path.with_name(path.name + _DAMAGED))
    with for_people(run.path):
        for folder in (run.hydra, run.params, run.source, run.asset, run.videos, run.dataset):
            _remove(temporaries(folder, deep=True))
        _remove(temporaries(run.path))
        _remove(films_from(run.videos, point.iteration))
        _remove(dataset_files_from(run.dataset, point.iteration))
        # Delete exported files such as ``policy.pt``, because they do not name the checkpoint of their policy.
        for path in run.exported.iterdir() if run.exported.is_dir() else ():
            if path.is_file():
                path.unlink()
            elif path in temporaries(run.exported):  # A killed export process can leave a temporary folder.
                shutil.rmtree(path)
        (run.path / FAILURE).unlink(missing_ok=True)  # Delete the simulation state that an earlier failure saved.
        if point.iteration == 0:
            run.recording.unlink(missing_ok=True)
    cut(run.iterations, point.lines[point.iteration - 1].end if point.iteration else 0)
    if events:
        cut_events(run.path, point.earlier_lines)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
