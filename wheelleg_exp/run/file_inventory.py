"""The files of a run directory: the size and the sha256 of each file, and differences from the recorded ones."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TypedDict

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import TEMPORARY_SUFFIX, for_people, sha256
from wheelleg_exp.run.run_lock import MANIFEST_LOCK, RUN_LOCK

MANIFEST_NAME = "manifest.json"
_OWN_FILES = {MANIFEST_NAME, RUN_LOCK, MANIFEST_LOCK}


class FileRecord(TypedDict):
    """The manifest's record of a file: digest of the content, and size in bytes."""

    sha256: str
    size: int


@dataclass
class FileFindings:
    """The sorted relative paths of a run's files that differ from the run's manifest."""

    # The manifest lists the ``missing`` files, but they do not exist or are symbolic links.
    missing: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    unlisted: list[str] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)  # ``links`` are symbolic links that the manifest does not list.

    def __bool__(self) -> bool:
        return bool(self.missing or self.changed or self.unlisted or self.unreadable or self.links)


def inventory(directory: Path) -> dict[str, FileRecord]:
    """Return the size and sha256 of each file below ``directory``; skip the manifest, locks, and temporary files."""
    return record_files(directory, _files(directory))


def record_files(directory: Path, paths: Iterable[Path]) -> dict[str, FileRecord]:
    """Return the size and sha256 of the given files below ``directory``, sorted by relative path."""
    records: dict[str, FileRecord] = {}
    for name in sorted({relative_name(directory, path) for path in paths}):
        digest = sha256(directory / name)
        with for_people(directory / name, "read"):
            records[name] = {"sha256": digest, "size": (directory / name).stat().st_size}
    return records


def compare_files(directory: Path, recorded: Mapping[str, FileRecord]) -> FileFindings:
    """Compare the files below ``directory`` with the sizes and sha256 values in a manifest."""
    present = {relative_name(directory, path) for path in _files(directory)}
    found = FileFindings(missing=sorted(set(recorded) - present), unlisted=sorted(present - set(recorded)))
    for name in sorted(present & set(recorded)):
        path, record = directory / name, recorded[name]
        try:
            with for_people(path, "read"):
                size = path.stat().st_size
            if size != record["size"] or sha256(path) != record["sha256"]:
                found.changed.append(name)
        except RunDirectoryError:
            found.unreadable.append(name)
    links = sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_symlink())
    found.links.extend(name for name in links if name not in recorded)
    return found


def odd_entries(directory: Path) -> dict[str, str]:
    """Return the names and types of entries below ``directory`` that are neither folders nor regular files."""
    # A symbolic link can lead outside the run directory, and reading from a pipe or a device may never end.
    found: dict[str, str] = {}
    for folder, folders, names in os.walk(directory):
        for path in (Path(folder, name) for name in [*folders, *names]):
            try:
                mode = path.lstat().st_mode
            # A running training can delete a temporary file between ``os.walk`` and ``lstat``.
            except FileNotFoundError:
                continue
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                name = path.relative_to(directory).as_posix()
                found[name] = "a symbolic link" if stat.S_ISLNK(mode) else "a pipe, a socket or a device"
    return dict(sorted(found.items()))


def relative_name(directory: Path, path: Path) -> str:
    """Return ``path`` relative to ``directory``, with forward slashes; a path outside ``directory`` raises an error."""
    base = directory.resolve()
    for full in (path.resolve(), (base / path).resolve()):
        if full.is_relative_to(base):
            return full.relative_to(base).as_posix()
    raise RunDirectoryError(f"the path '{path}' is outside the run directory", expected=f"a path below '{directory}'")


def is_inside(name: str) -> bool:
    """Return whether a relative path from a manifest stays inside the run directory."""
    path = PurePosixPath(name)
    return bool(name) and not path.is_absolute() and ".." not in path.parts and not {"\\", "\0"} & set(name)


def _files(directory: Path) -> Iterator[Path]:
    for path in directory.rglob("*"):
        own = path.parent == directory and path.name in _OWN_FILES
        unfinished = path.name.startswith(".") and path.name.endswith(TEMPORARY_SUFFIX)
        if path.is_file() and not path.is_symlink() and not own and not unfinished:
            yield path
