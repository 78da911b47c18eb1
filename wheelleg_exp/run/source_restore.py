"""Restore the source code that was recorded with a run into a new folder."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.files import for_people, read_bytes, read_json, require_mapping, temporary_folder
from wheelleg_exp.run.file_inventory import is_inside
from wheelleg_exp.run.git_commands import OBJECT_ID, GitError, Repository, run_git
from wheelleg_exp.run.records import read_record
from wheelleg_exp.run.source_changes import SourceRecord
from wheelleg_exp.run.source_snapshot import RECORD_NAME, SOURCE_FORMAT

_FULL_DISK = re.compile("no space left|quota exceeded", re.IGNORECASE)
_ROOM_BYTES = 1 << 16
_PATCH = re.compile(r"source(_[0-9]+)?\.patch")

# With ``_SETTINGS``, git neither converts line ends nor downloads Git LFS files.
_SETTINGS = {"core.autocrlf": "false", "core.eol": "lf", "core.hooksPath": os.devnull, "filter.lfs.required": "false"}
_SETTINGS |= dict.fromkeys(("filter.lfs.smudge", "filter.lfs.clean", "filter.lfs.process"), "")


@dataclass
class _Content(SourceRecord):
    """The content of ``git.json``: the record of the main repository, and the records of the other repositories."""

    others: list[SourceRecord] = field(default_factory=list)


def load_source(directory: os.PathLike[str]) -> list[SourceRecord]:
    """Return the records in a run's ``source/git.json``, the main repository first; an unsafe value is an error."""
    path = Path(directory) / "source" / RECORD_NAME
    where, content = str(path), require_mapping(read_json(path), path)
    if content.get("format") != SOURCE_FORMAT:
        message = "this is not a record of a source tree"
        raise RunDirectoryError(message, where=where, expected=f"format {SOURCE_FORMAT}")
    first = read_record(_Content, content, "broken record of the source", path)
    records = [first, *first.others]
    for entry in records:
        for key, pattern in {**dict.fromkeys(("commit", "base", "tree"), OBJECT_ID), "patch": _PATCH}.items():
            value = getattr(entry, key)
            if value is not None and not pattern.fullmatch(value):
                raise RunDirectoryError(f"broken record of the source: {key} has the value {value!r}", where=where)
        for name in entry.folders:
            if not is_inside(name):
                raise RunDirectoryError(f"git.json names the path '{name}' outside the git repository", where=where)
    return records


def find_origin(record: SourceRecord, candidates: Sequence[Path]) -> Path | None:
    """Return the first given folder whose git repository has the recorded commit; None if no commit is recorded."""
    # If no folder contains the recorded commit, the error names the git command that fetches the commit.
    commit = record.commit
    if commit is None:
        return None
    complaints = []
    for folder in dict.fromkeys(candidates):
        try:
            run_git(folder, "cat-file", "-e", f"{commit}^{{commit}}")
        except GitError as error:
            known = "does not contain it" if "Not a valid object name" in str(error) else str(error)
            complaints.append(f"{folder}: {known}")
        else:
            return folder
    url = record.remote and record.remote.get("url")
    fetch = f"git fetch {url or '<the repository of the run>'} {commit}"
    searched = "; ".join(complaints) or "no repository was searched"
    message = f"no repository here contains commit {commit} of '{record.root}' ({searched})"
    expected = f"--repository with a clone that contains it; inside a clone, '{fetch}' fetches it"
    raise RunDirectoryError(message, expected=expected)


def restore_source(
    directory: os.PathLike[str], destination: Path, repository: Path | None = None, *, which: int = 0
) -> str:
    """Restore the source tree recorded with a run into the new folder ``destination``, and return its git tree id.

    ``repository`` is a clone that contains the run's commit, by default the folder in which the run found its source;
    it is only read. ``which`` is 0 for the main repository of the run, and 1 for the first additional one.
    ``destination`` becomes a git repository that reads the objects of ``repository``. If the restored files differ from
    the recorded ones, it is deleted and an error is raised. No file outside ``destination`` is written, even if the
    recorded patch contains such paths. A full disk raises SimulationFailure.
    """
    record = load_source(directory)[which]
    if record.patch is None or record.tree is None:
        raise RunDirectoryError(f"the run did not store its source code ({record.status}): {record.note}")
    if destination.exists():
        raise RunDirectoryError(f"'{destination}' already exists", expected="a new folder")
    path = Path(directory) / "source" / record.patch
    change = read_bytes(path)
    if hashlib.sha256(change).hexdigest() != record.patch_sha256:
        message, expected = "the patch has been changed since the run recorded it", record.patch_sha256
        raise RunDirectoryError(message, where=str(path), expected=f"the recorded sha256 {expected}")
    origin = find_origin(record, [repository or Path(record.root or ".")])
    with for_people(destination), temporary_folder(destination) as unfinished:
        _rebuild(record.commit, record.tree, origin, unfinished, change)
        unfinished.rename(destination)
    return record.tree


def _rebuild(commit: str | None, expected: str, origin: Path | None, folder: Path, change: bytes) -> None:
    try:
        # Create an empty repository that reads the git objects of ``origin``, but not the settings of ``origin``.
        kind = "sha256" if len(expected) > 40 else "sha1"
        run_git(folder, "init", "--quiet", "--template=", f"--object-format={kind}")
        clone = Repository(folder.absolute())
        for key, value in _SETTINGS.items():
            clone.run("config", key, value)
        if origin is not None:
            name = os.fsdecode(run_git(origin, "rev-parse", "--git-path", "objects")).removesuffix("\n")
            objects = origin.resolve() / name
            alternates = folder / ".git" / "objects" / "info" / "alternates"
            with for_people(alternates):
                alternates.parent.mkdir(parents=True, exist_ok=True)
                alternates.write_bytes(os.fsencode(objects.resolve()) + b"\n")
        if commit:
            clone.run("update-ref", "--no-deref", "HEAD", commit)
            clone.run("read-tree", commit)
        if change:
            # With --cached, git applies the patch only to git's index and writes no files, so no line ends change.
            clone.run("apply", "--cached", "--binary", "--whitespace=nowarn", "-", stdin=change)
        tree = clone.text("write-tree")
        if tree != expected:
            message = f"the restored source has the tree {tree}"
            raise RunDirectoryError(message, expected=f"the recorded {expected}")
        clone.run("checkout-index", "--all", "--force")
    except GitError as error:
        where = f" from '{origin}'" if origin else ""
        # Git does not report why it failed to write a file, so check whether the disk is full.
        if _FULL_DISK.search(str(error)) or shutil.disk_usage(folder).free < _ROOM_BYTES:
            message = f"the source cannot be restored: {error}"
            raise SimulationFailure(message, expected="room on a working disk") from error
        raise RunDirectoryError(f"the source code of the run cannot be restored{where}: {error}") from error
