"""What a run must be before it is replayed: ended, and with the snapshot that its manifest recorded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import sha256
from wheelleg_exp.run.directory import NEEDED, RunDirectory
from wheelleg_exp.run.inventory import MANIFEST_NAME
from wheelleg_exp.run.log import read_log
from wheelleg_exp.run.manifest import SNAPSHOT, Manifest
from wheelleg_exp.run.process import is_alive
from wheelleg_exp.run.recorded import OVERRIDES

_NEEDED = (*NEEDED, OVERRIDES, "source/git.json")


def iterations_to_train(run: RunDirectory, manifest: Manifest, wanted: int | None) -> int:
    """Return how many iterations a replay trains: those that the run has, or fewer.

    Raises:
        RunDirectoryError: the run still goes on, has none, or has fewer than are wanted.
    """
    if manifest.status == "running" and is_alive(manifest.data.get("process") or {}):
        raise RunDirectoryError(f"run '{run.id}' is still running", expected="a run that has ended")
    log = read_log(run.iterations)
    there = len(log.lines)
    if not there:
        raise RunDirectoryError(f"run '{run.id}' has no whole iteration to compare with", where=str(run.iterations))
    if wanted is None:
        return there
    if not 1 <= wanted <= there:
        raise RunDirectoryError(f"is {wanted}", key="--iterations", expected=f"from 1 to the {there} that the run has")
    return wanted


def require_whole_snapshot(run: RunDirectory, manifest: Manifest) -> None:
    """Refuse a snapshot that is not, byte for byte, what the manifest recorded.

    Raises:
        RunDirectoryError: a file of it is missing, changed, or not the run's own; the manifest itself was changed; or
            several processes have trained the run.
    """
    if manifest.seal_holds() is False:
        raise RunDirectoryError(
            "the manifest is not what the run wrote", where=str(run.path / MANIFEST_NAME), expected="an unchanged run"
        )
    processes = int((manifest.data.get("ranks") or {}).get("world_size", 1))
    if processes > 1:
        raise RunDirectoryError(
            f"run '{run.id}' was trained by {processes} processes, and a replay trains with one",
            expected="'wheelleg train' again with the recorded command under torchrun, and 'wheelleg verify A B'",
        )
    recorded = {name: entry for name, entry in manifest.data["files"].items() if name.startswith(SNAPSHOT)}
    absent = next((name for name in _NEEDED if name not in recorded), None)
    if absent is not None:
        raise RunDirectoryError(
            f"the snapshot of run '{run.id}' is not whole: its manifest names no {absent}",
            expected="a run that got as far as its first iteration",
        )
    for name, entry in recorded.items():
        path = run.inside(name)
        if not path.is_file():
            raise RunDirectoryError(f"{name} is missing", where=str(path), expected="a run with its whole snapshot")
        if sha256(path) != entry["sha256"]:
            raise RunDirectoryError(
                f"{name} is not what the manifest recorded", where=str(path), expected="a snapshot nobody has changed"
            )
    for path in _snapshot_files(run):
        name = path.relative_to(run.path).as_posix()
        if name not in recorded:
            raise RunDirectoryError(f"{name} is not in the manifest", where=str(path), expected="the run's own files")


def _snapshot_files(run: RunDirectory) -> Iterator[Path]:
    for folder in (run.hydra, run.params, run.source, run.asset):
        yield from (path for path in sorted(folder.rglob("*")) if not path.is_dir())
