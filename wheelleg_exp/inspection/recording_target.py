"""Find the file of the Rerun recording that a command-line argument names."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_list import effective_status
from wheelleg_exp.run.run_lock import RUN_LOCK, RunLock

RECORDING = "recording.rrd"
_SUFFIX = ".rrd"


@dataclass(frozen=True)
class Target:
    """The file of a Rerun recording; ``run`` is the training run that wrote the file, or None."""

    path: Path
    run: RunDirectory | None

    @property
    def status(self) -> str | None:
        """The training run's status, such as ``running``; None if the file is not the recording of a training."""
        if self.run is None or self.path.resolve() != self.run.recording.resolve():
            return None
        return effective_status(self.run.manifest())

    def resting(self) -> AbstractContextManager[object]:
        """Return a lock of the recording's run directory; while it is locked, no process can resume the run."""
        # Skip the lock if the user has no write access to the lock file, because this user cannot resume the run.
        if self.run is None or self.status is None or not os.access(self.run.path / RUN_LOCK, os.W_OK):
            return nullcontext()
        return RunLock(self.run)

    def others(self) -> list[Path]:
        found = recordings_of(self.run) if self.run is not None else []
        return [path for path in found if path.resolve() != self.path.resolve()]


def find_target(word: str | Path, root: Path, *, play: bool = False) -> Target:
    """Return the file and the run of the recording that a command-line argument, such as ``latest``, names.

    It is a recording's file, a folder with one such as ``<run>/play/<time>``, or a run: its path, its id, or
    ``latest``. A run means the recording of its training, or with ``play`` the newest one that ``wheelleg play`` made.
    """
    path = Path(word)
    if path.exists() and not names_a_run(word):
        if play:
            raise WheellegError(f"'{path}' is not a run directory", key="--play", expected="a run with a recorded play")
        run = _run_around(path)
        if path.is_dir():
            found = [name for name in (RECORDING,) if (path / name).is_file()]
            found = found or sorted(file.name for file in path.glob(f"*{_SUFFIX}"))
            if len(found) != 1:
                expected = (
                    "one of " + ", ".join(found) if found else f"a run, a recording, or a folder with {RECORDING}"
                )
                message = f"'{path}' is not a run, and contains {len(found) or 'no'} recordings"
                raise RunDirectoryError(message, expected=expected)
            path = path / found[0]
        return Target(path, run)
    if path.suffix == _SUFFIX and path.is_symlink() and not path.exists():
        raise RunDirectoryError(f"'{path}' is a broken symbolic link", expected="a recording")
    if path.suffix == _SUFFIX and not path.exists():
        like = nearest_name(path.name, [p.name for p in path.parent.glob(f"*{_SUFFIX}")])
        nearest = str(path.with_name(like)) if like else None
        raise RunDirectoryError(f"there is no file '{path}'", expected="a recording", nearest=nearest)
    run = RunDirectory.open(word, root)
    if not play:
        return Target(_training(run), run)
    plays = sorted(path for path in run.play.glob(f"*/{RECORDING}") if path.is_file())
    if not plays:
        expected = f"one made by 'wheelleg play {run.id}'"
        raise RunDirectoryError(f"run '{run.id}' has no recording by 'wheelleg play'", key="--play", expected=expected)
    return Target(plays[-1], run)


def names_a_run(word: str | Path) -> bool:
    """Return whether a command-line argument names a run; an argument that is not a path is treated as a run's id."""
    path = Path(word)
    return not path.exists() or (path.is_dir() and (path / MANIFEST_NAME).is_file())


def recordings_of(run: RunDirectory) -> list[Path]:
    """Return the recordings of a run: of its training, then of its plays and evaluations by name."""
    later = [path for folder in (run.play, run.evaluation) for path in sorted(folder.glob(f"**/*{_SUFFIX}"))]
    return [path for path in (run.recording, *later) if path.is_file()]


def _training(run: RunDirectory) -> Path:
    if run.recording.is_file():
        return run.recording
    options = written_config(run).get("recording")
    is_disabled = isinstance(options, dict) and options.get("enabled") is False
    reason = "it was trained with recording.enabled=false" if is_disabled else f"there is no {RECORDING}"
    others = [path.relative_to(run.path) for path in recordings_of(run)]
    hint = f"; its plays were recorded: {', '.join(map(str, others))}" if others else ""
    message = f"run '{run.id}' has no recording of its training: {reason}{hint}"
    raise RunDirectoryError(message, expected="a recorded run, or --play")


def _run_around(path: Path) -> RunDirectory | None:
    for folder in path.resolve().parents:
        if (folder / MANIFEST_NAME).is_file():
            try:
                return RunDirectory.open(folder, folder.parent)
            except WheellegError:  # A damaged run directory can contain a readable recording.
                return None
    return None
