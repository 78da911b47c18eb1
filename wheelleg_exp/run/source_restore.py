"""Restore the source code that was recorded with a run into a new folder."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.files import for_people, read_bytes, read_json, require_mapping, temporary_folder
from wheelleg_exp.run.file_inventory import is_inside
from wheelleg_exp.run.git_commands import OBJECT_ID, GitError, Repository, run_git
from wheelleg_exp.run.manifest import Optional, mistyped_keys
from wheelleg_exp.run.source_snapshot import RECORD_NAME, SOURCE_FORMAT, new_record

_FULL_DISK = re.compile("no space left|quota exceeded", re.IGNORECASE)
_ROOM_BYTES = 1 << 16
_NAMES, _TEXT = Optional([str]), Optional(str)
_RECORD = {
    **dict.fromkeys(("root", "commit", "base", "tree", "patch", "patch_sha256", "content_sha256", "note"), _TEXT),
    **dict.fromkeys(("status", "branch", "distribution"), _TEXT),
    **dict.fromkeys(("folders", "untracked", "changed"), _NAMES),
    "remote": Optional({"name": _TEXT, "url": _TEXT}),
    "exact": Optional(bool),
    "patch_bytes": Optional(int),
    "refused": Optional([{"path": str, "reason": str}]),
    "submodules": Optional([{"path": str, "commit": str}]),
}
_PATCH = re.compile(r"source(_[0-9]+)?\.patch")

# With ``_SETTINGS``, git neither converts line ends nor downloads Git LFS files.
_SETTINGS = {"core.autocrlf": "false", "core.eol": "lf", "core.hooksPath": os.devnull, "filter.lfs.required": "false"}
_SETTINGS |= dict.fromkeys(("filter.lfs.smudge", "filter.lfs.clean", "filter.lfs.process"), "")


def load_source(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return the content of a run's ``source/git.json``; raise RunDirectoryError if a value is invalid or unsafe."""
    path = Path(directory) / "source" / RECORD_NAME
    where, content = str(path), require_mapping(read_json(path), path)
    if content.get("format") != SOURCE_FORMAT:
        message = "this is not a record of a source tree"
        raise RunDirectoryError(message, where=where, expected=f"format {SOURCE_FORMAT}")
    for wrong in mistyped_keys(content, {**_RECORD, "others": Optional([_RECORD])}):
        raise RunDirectoryError(f"broken record of the source: the key '{wrong}' is missing or wrong", where=where)
    first, *others = ({**new_record("failed", None, None), **e} for e in (content, *(content.get("others") or ())))
    for entry in (first, *others):
        for key, pattern in {**dict.fromkeys(("commit", "base", "tree"), OBJECT_ID), "patch": _PATCH}.items():
            if entry[key] is not None and not pattern.fullmatch(str(entry[key])):
                raise RunDirectoryError(f"broken record of the source: {key} has the value {entry[key]!r}", where=where)
        for name in entry["folders"] or ():
            if not is_inside(str(name)):
                raise RunDirectoryError(f"git.json names the path '{name}' outside the git repository", where=where)
    return {**first, "others": others}


def source_records(directory: os.PathLike[str]) -> list[dict[str, Any]]:
    """Return the source record of each source repository of a run; the repository of wheelleg_exp is the first."""
    content = load_source(directory)
    return [content, *content["others"]]


def find_origin(record: dict[str, Any], candidates: Sequence[Path]) -> Path | None:
    """Return the first given folder whose git repository has the recorded commit; None if no commit is recorded."""
    # If no folder contains the recorded commit, the error names the git command that fetches the commit.
    commit = record["commit"]
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
    remote = record.get("remote") or {}
    fetch = f"git fetch {remote.get('url') or '<the repository of the run>'} {commit}"
    searched = "; ".join(complaints) or "no repository was searched"
    message = f"no repository here contains commit {commit} of '{record['root']}' ({searched})"
    expected = f"--repository with a clone that contains it; inside a clone, '{fetch}' fetches it"
    raise RunDirectoryError(message, expected=expected)


def restore_source(
    directory: os.PathLike[str], destination: Path, repository: Path | None = None, *, which: int = 0
) -> str:
    """Restore the source tree recorded with a run into the new folder ``destination``, and return its git tree id.

    ``repository`` is a git clone that contains the commit of the run's source code. The default clone is the folder in
    which the run found its source code. ``restore_source`` only reads the clone. ``which`` is 0 for the main repository
    of the run, and 1 for the first additional repository. ``destination`` becomes a separate git repository that reads
    the git objects of ``repository``. If the restored and the recorded source files differ, ``destination`` is deleted
    and an error is raised. No file outside ``destination`` is written, even if the recorded patch contains paths
    outside ``destination``. A full disk raises SimulationFailure.
    """
    record = source_records(directory)[which]
    if record["patch"] is None:
        raise RunDirectoryError(f"the run did not store its source code ({record['status']}): {record['note']}")
    if destination.exists():
        raise RunDirectoryError(f"'{destination}' already exists", expected="a new folder")
    path = Path(directory) / "source" / record["patch"]
    change = read_bytes(path)
    if hashlib.sha256(change).hexdigest() != record["patch_sha256"]:
        message, expected = "the patch has been changed since the run recorded it", record["patch_sha256"]
        raise RunDirectoryError(message, where=str(path), expected=f"the recorded sha256 {expected}")
    origin = find_origin(record, [repository or Path(record["root"])])
    with for_people(destination), temporary_folder(destination) as unfinished:
        _rebuild(record, origin, unfinished, change)
        unfinished.rename(destination)
    return record["tree"]


def _rebuild(record: dict[str, Any], origin: Path | None, folder: Path, change: bytes) -> None:
    try:
        # Create an empty repository that reads the git objects of ``origin``, but not the settings of ``origin``.
        kind = "sha256" if len(record["tree"]) > 40 else "sha1"
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
        if record["commit"]:
            clone.run("update-ref", "--no-deref", "HEAD", record["commit"])
            clone.run("read-tree", record["commit"])
        if change:
            # With --cached, git applies the patch only to git's index and writes no files, so no line ends change.
            clone.run("apply", "--cached", "--binary", "--whitespace=nowarn", "-", stdin=change)
        tree = clone.text("write-tree")
        if tree != record["tree"]:
            message = f"the restored source has the tree {tree}"
            raise RunDirectoryError(message, expected=f"the recorded {record['tree']}")
        clone.run("checkout-index", "--all", "--force")
    except GitError as error:
        where = f" from '{origin}'" if origin else ""
        # Git does not report why it failed to write a file, so check whether the disk is full.
        if _FULL_DISK.search(str(error)) or shutil.disk_usage(folder).free < _ROOM_BYTES:
            message = f"the source cannot be restored: {error}"
            raise SimulationFailure(message, expected="room on a working disk") from error
        raise RunDirectoryError(f"the source code of the run cannot be restored{where}: {error}") from error
