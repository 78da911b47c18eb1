"""Resolve the command-line argument RUN or FILE to a recording's file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RUN_LOCK, RunLock

RECORDING = "recording.rrd"
_SUFFIX = ".rrd"


@dataclass(frozen=True)
class Target:
    """A recording's file, and its run if it has one."""

    path: Path
    run: RunDirectory | None

    @property
    def status(self) -> str | None:
        """The status of the run if this is its training's recording, or None."""
        from wheelleg_exp.run.run_list import effective_status

        if self.run is None or self.path.resolve() != self.run.recording.resolve():
            return None
        return effective_status(self.run.manifest())

    @contextmanager
    def resting(self) -> Iterator[None]:
        """Lock the run of the recording while the body runs, so that it cannot continue.

        Raises:
            RunDirectoryError: a process is writing the run.
        """
        run = self.run if self.status is not None else None
        lock = None if run is None else run.path / RUN_LOCK
        if run is None or lock is None or not os.access(lock, os.W_OK):  # no process can write the run
            yield
            return
        with RunLock(run).held():
            yield

    def others(self) -> list[Path]:
        """Return the run's other recordings."""
        found = recordings_of(self.run) if self.run is not None else []
        return [path for path in found if path.resolve() != self.path.resolve()]


def find_target(word: str | Path, root: Path, *, play: bool = False) -> Target:
    """Return the recording of a word from the command line.

    Args:
        word: a file; a folder with a recording, such as ``<run>/play/<time>``; or a run by path, id, or ``latest``, for
            its training's recording.
        root: the folder of all runs.
        play: whether to return the newest play of the run instead.

    Raises:
        RunDirectoryError: there is no such recording.
        WheellegError: ``play`` is set, but the word is not a run.
    """
    path = Path(word)
    if path.exists() and not names_a_run(word):
        if play:
            raise WheellegError(f"'{path}' is not a run", key="--play", expected="a run with a recorded play")
        return Target(_in_folder(path) if path.is_dir() else path, _run_around(path))
    if path.suffix == _SUFFIX and path.is_symlink() and not path.exists():
        raise RunDirectoryError(f"'{path}' is a broken link", expected="a recording")
    if path.suffix == _SUFFIX and not path.exists():
        raise RunDirectoryError(f"there is no file '{path}'", expected="a recording", nearest=_like(path))
    run = RunDirectory.open(word, root)
    return Target(_newest_play(run) if play else _training(run), run)


def names_a_run(word: str | Path) -> bool:
    """Return whether a word is a run. A word that is no path counts as a run's id."""
    path = Path(word)
    return not path.exists() or (path.is_dir() and (path / MANIFEST_NAME).is_file())


def recordings_of(run: RunDirectory) -> list[Path]:
    """Return the recordings of a run: the training's, then those of its plays and evaluations by name."""
    later = [path for folder in (run.play, run.evaluation) for path in sorted(folder.glob(f"**/*{_SUFFIX}"))]
    return [path for path in (run.recording, *later) if path.is_file()]


def _training(run: RunDirectory) -> Path:
    if run.recording.is_file():
        return run.recording
    reason = "it was trained with recording.enabled=false" if _is_disabled(run) else f"there is no {RECORDING}"
    others = [path.relative_to(run.path) for path in recordings_of(run)]
    hint = f"; its plays were recorded: {', '.join(map(str, others))}" if others else ""
    raise RunDirectoryError(
        f"run '{run.id}' has no recording of its training: {reason}{hint}", expected="a recorded run, or --play"
    )


def _newest_play(run: RunDirectory) -> Path:
    found = sorted(path for path in run.play.glob(f"*/{RECORDING}") if path.is_file())
    if not found:
        raise RunDirectoryError(
            f"run '{run.id}' has no recorded play", key="--play", expected=f"one made by 'wheelleg play {run.id}'"
        )
    return found[-1]


def _is_disabled(run: RunDirectory) -> bool:
    options = written_config(run).get("recording")
    return isinstance(options, dict) and options.get("enabled") is False


def _in_folder(folder: Path) -> Path:
    if (folder / RECORDING).is_file():
        return folder / RECORDING
    found = sorted(path.name for path in folder.glob(f"*{_SUFFIX}"))
    if len(found) == 1:
        return folder / found[0]
    expected = "one of " + ", ".join(found) if found else f"a run, a recording, or a folder with {RECORDING}"
    count = len(found) or "no"
    raise RunDirectoryError(f"'{folder}' is not a run, and contains {count} recordings", expected=expected)


def _run_around(path: Path) -> RunDirectory | None:
    for folder in path.resolve().parents:
        if (folder / MANIFEST_NAME).is_file():
            try:
                return RunDirectory.open(folder, folder.parent)
            except WheellegError:  # a damaged run can still have a readable recording
                return None
    return None


def _like(path: Path) -> str | None:
    names = [p.name for p in path.parent.glob(f"*{_SUFFIX}")] if path.parent.is_dir() else []
    found = nearest_name(path.name, names)
    return str(path.with_name(found)) if found else None
