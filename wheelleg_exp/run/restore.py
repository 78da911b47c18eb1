"""The recorded source tree again, in a folder of its own."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.files import for_people, read_json
from wheelleg_exp.run.git import GitError, Repository, run_git
from wheelleg_exp.run.source import FORMAT, RECORD_NAME


def load_source(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return the content of a run's ``source/git.json``.

    Raises:
        RunDirectoryError: it is missing, broken, or of a format that is not known here.
    """
    path = Path(directory) / "source" / RECORD_NAME
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise RunDirectoryError("this describes no source tree", where=str(path), expected=f"format {FORMAT}")
    return record


def restore_source(
    directory: os.PathLike[str], destination: Path, repository: Path | None = None, *, which: int = 0
) -> str:
    """Make the recorded tree of a run in the new folder ``destination`` and return its tree id.

    The user's repository is read, never written: ``destination`` becomes a clone that borrows its objects.
    It is there only when its tree is the recorded one.

    Args:
        directory: the run directory.
        destination: the folder to make.
        repository: a clone that holds the recorded commit, by default the recorded folder.
        which: 0 for the main repository, 1 for the first of the others.

    Raises:
        RunDirectoryError: the source was not kept, the commit is not there, the result is not the recorded
            tree, or the folder exists.
    """
    content = load_source(directory)
    record = [content, *content["others"]][which]
    if record["patch"] is None:
        raise RunDirectoryError(f"the source was not kept ({record['status']}): {record['note']}")
    if destination.exists():
        raise RunDirectoryError(f"'{destination}' exists already", expected="a new folder")
    patch = Path(directory) / "source" / record["patch"]
    with for_people(patch, "read"):
        change = patch.read_bytes()
    origin = repository or Path(record["root"])
    unfinished = destination.with_name(f".{destination.name}.{secrets.token_hex(6)}.tmp")
    try:
        _rebuild(record, origin, unfinished, change)
        with for_people(destination):
            unfinished.rename(destination)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return record["tree"]


def _rebuild(record: dict[str, Any], origin: Path, folder: Path, change: bytes) -> None:
    with for_people(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        clone = _clone(origin, folder, record["commit"])
        if change:
            # Into the index, where no setting about line ends or white space can change a byte.
            clone.run("apply", "--cached", "--binary", "--whitespace=nowarn", "-", stdin=change)
        tree = clone.text("write-tree")
        clone.run("checkout-index", "--all", "--force")
    except GitError as error:
        commit = record["commit"]
        raise RunDirectoryError(
            f"the source cannot be restored from '{origin}': {error}",
            expected=f"a repository that holds commit {commit}" if commit else "an empty repository",
        ) from error
    if tree != record["tree"]:
        raise RunDirectoryError(f"the restored tree is {tree}", expected=f"the recorded {record['tree']}")


def _clone(origin: Path, folder: Path, commit: str | None) -> Repository:
    where = str(folder.absolute())
    run_git(origin, "clone", "--quiet", "--shared", "--no-checkout", "--", str(origin.resolve()), where)
    clone = Repository(folder.absolute())
    if commit:
        clone.run("update-ref", "--no-deref", "HEAD", commit)
        clone.run("read-tree", commit)
    return clone
