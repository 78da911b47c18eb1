"""Drops from a run's logs, events, films and exports what stands past the checkpoint from which it goes on."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

from wheelleg_exp.files import cut, for_people, temporaries
from wheelleg_exp.jobs.dataset import dataset_files_from
from wheelleg_exp.jobs.resume.point import ResumePoint
from wheelleg_exp.jobs.train.event_files import cut_events
from wheelleg_exp.jobs.train.films import films_from
from wheelleg_exp.run.directory import FAILURE, RunDirectory

_DAMAGED = ".damaged"


def drop_past_checkpoint(run: RunDirectory, point: ResumePoint, *, events: bool) -> None:
    """Drop from the run's files what stands past the checkpoint, and what a kill left unfinished.

    Without ``events`` the run writes none, and those of earlier days stay as they are.
    """
    for path in point.damaged:
        with for_people(path):
            path.replace(path.with_name(path.name + _DAMAGED))
    with for_people(run.path):
        for folder in (run.hydra, run.params, run.source, run.asset, run.videos, run.dataset):
            _remove(temporaries(folder, deep=True))
        _remove(temporaries(run.path))
        _remove(films_from(run.videos, point.iteration))
        _remove(dataset_files_from(run.dataset, point.iteration))
        _remove_exported(run.exported)
        (run.path / FAILURE).unlink(missing_ok=True)  # what it says stands in the manifest
        if point.iteration == 0:
            run.recording.unlink(missing_ok=True)
    cut(run.iterations, point.log_size)
    if events:
        cut_events(run.path, point.kept)


def _remove_exported(folder: Path) -> None:
    """Remove the policy's files, which would tell of one that is trained further; bundles say whose they are."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.is_file():
            path.unlink()
        elif path in temporaries(folder):  # of an export that was killed
            shutil.rmtree(path)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)
