"""The state of the source tree, kept with the run: a commit, a tree id, and a patch that restores it.

``git.json`` describes the repository of each root, the main one first; ``source.patch`` (``source_2.patch``
for a second repository) makes the recorded tree from the recorded commit, untracked and binary files
included. Ignored files, the folder of runs, and files that look like keys or tokens are left out.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.run import worktree
from wheelleg_exp.run.files import sha256, write_bytes, write_json
from wheelleg_exp.run.git import GitError, Repository, run_git, scratch_index
from wheelleg_exp.run.secrecy import without_credentials

FORMAT = 1
PATCH_NAME = "source.patch"
RECORD_NAME = "git.json"

# The first two come with a patch that restores the tree; the others with a note that says why not.
Status = Literal["ok", "no_commits", "no_repository", "installed", "patch_too_large", "no_git", "failed"]

_INSTALL_FOLDERS = ("site-packages", "dist-packages")
_BIG_FILES_SHOWN = 20


def snapshot_source(
    roots: Sequence[Path], folder: Path, *, runs_root: Path | None = None, max_patch_mb: float = 50.0
) -> dict[str, Any]:
    """Write ``git.json`` and the patches into ``folder`` and return the content of ``git.json``.

    Whatever git says, the run goes on: a source that cannot be kept is recorded with a status and a note.

    Args:
        roots: folders whose source matters, the package's own first; roots of one repository count once.
        folder: the run's ``source`` folder.
        runs_root: folder of the runs, whose untracked files are left out.
        max_patch_mb: largest patch, and largest sum of untracked files, in megabytes (10^6 bytes).

    Raises:
        SimulationFailure: the disk is full.
        RunDirectoryError: the folder cannot be written.
    """
    records: list[dict[str, Any]] = []
    for place, inside in _group(roots):
        patch = None
        if isinstance(place, Repository):
            record, patch = _snapshot_repository(place, runs_root, int(max_patch_mb * 1e6))
        else:
            record = place
        record["folders"] = inside
        if patch is not None:
            record["patch"] = PATCH_NAME if not records else f"source_{len(records) + 1}.patch"
            write_bytes(folder / record["patch"], patch)
        records.append(record)
    if not records:
        records.append(_record("no_repository", None, "no source folder was given"))
    content = {"format": FORMAT, **records[0], "others": records[1:]}
    write_json(folder / RECORD_NAME, content)
    return content


def _group(roots: Iterable[Path]) -> list[tuple[Repository | dict[str, Any], list[str]]]:
    """Return each repository once with its roots inside it, or a root's record where there is none."""
    groups: dict[Path, tuple[Repository | dict[str, Any], list[str]]] = {}
    for root in dict.fromkeys(Path(root).resolve() for root in roots):
        place = _place(root)
        if isinstance(place, Repository):
            inside = root.relative_to(place.top.resolve()).as_posix()
            groups.setdefault(place.top, (place, []))[1].append(inside)
        else:
            groups[root] = (place, ["."])
    return list(groups.values())


def _place(root: Path) -> Repository | dict[str, Any]:
    """Return the repository that ``root`` is worked on in, or a record that says why there is none."""
    folder = root if root.is_dir() else root.parent
    try:
        top = os.fsdecode(run_git(folder, "rev-parse", "--show-toplevel")).removesuffix("\n")
    except GitError as error:
        return _without_repository(root, str(error))
    repository = Repository(Path(top))
    return _installed(root) if _is_installed(root, repository) else repository


def _without_repository(root: Path, complaint: str) -> dict[str, Any]:
    if any(part in _INSTALL_FOLDERS for part in root.parts):
        return _installed(root)
    if "not a git repository" in complaint:
        note = f"'{root}' is in no git repository, so its source is not kept; 'git init' there changes that"
        return _record("no_repository", root, note)
    if "git is not installed" in complaint:
        return _record("no_git", root, "git is not installed, so the source is not kept")
    return _record("failed", root, f"git: {complaint}")


def _is_installed(root: Path, repository: Repository) -> bool:
    """Return whether ``root`` only happens to lie in a repository: in an environment, or ignored by it."""
    top = repository.top.resolve()
    if root == top:
        return False
    if any(part in _INSTALL_FOLDERS for part in root.relative_to(top).parts):
        return True
    return repository.maybe("check-ignore", "--", str(root)) is not None


def _installed(root: Path) -> dict[str, Any]:
    note = f"'{root}' is installed outside a repository, or ignored by the one around it: its digest is kept"
    return {**_record("installed", root, note), "content_sha256": content_digest(root)}


def content_digest(folder: Path) -> str:
    """Return one sha256 over names and contents of the readable files below ``folder``, bytecode left out."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts and os.access(path, os.R_OK):
            digest.update(os.fsencode(path.relative_to(folder)) + b"\0" + sha256(path).encode() + b"\n")
    return digest.hexdigest()


def _snapshot_repository(
    repository: Repository, runs_root: Path | None, cap: int
) -> tuple[dict[str, Any], bytes | None]:
    record = _record("ok", repository.top, None)
    try:
        _describe_commit(repository, record)
        return record, _capture(repository, record, runs_root, cap)
    except GitError as error:
        record.update(status="failed", note=f"git: {error}")
        return record, None


def _describe_commit(repository: Repository, record: dict[str, Any]) -> None:
    commit = repository.maybe("rev-parse", "--verify", "--quiet", "HEAD")
    record["commit"] = commit
    record["base"] = commit or repository.text("hash-object", "-t", "tree", os.devnull)
    record["branch"] = repository.maybe("symbolic-ref", "-q", "--short", "HEAD")
    record["remote"] = _remote(repository, record["branch"])
    if commit is None:
        record["status"] = "no_commits"


def _capture(repository: Repository, record: dict[str, Any], runs_root: Path | None, cap: int) -> bytes | None:
    """Fill the record with the tree and return the patch; None when it would be too large."""
    untracked, refused = worktree.untracked_files(repository, runs_root)
    record["refused"] = [asdict(entry) for entry in refused]
    sizes = worktree.file_sizes(repository, untracked)
    if sum(sizes.values()) > cap:
        _refuse_patch(record, sizes, "the untracked files have", sum(sizes.values()), cap)
        return None
    with scratch_index(repository) as scratch:
        worktree.add_everything(scratch, untracked)
        changes = worktree.changes_from(scratch, record["base"])
        refused += worktree.refuse_secrets(scratch, changes)
        left_out = {entry.path for entry in refused}
        record["refused"] = [asdict(entry) for entry in refused]
        record["untracked"] = [path for path in untracked if path not in left_out]
        record["dirty"] = bool(changes or refused)
        record["submodules"] = worktree.submodules(scratch)
        record["tree"] = scratch.text("write-tree")
        patch = worktree.patch_from(scratch, record["base"])
        if len(patch) > cap:
            sizes = worktree.new_sizes(scratch, [c for c in changes if c.path not in left_out])
            _refuse_patch(record, sizes, "the patch has", len(patch), cap)
            return None
    record.update(patch_bytes=len(patch), patch_sha256=hashlib.sha256(patch).hexdigest(), note=_note(record))
    return patch


def _record(status: Status, root: Path | None, note: str | None) -> dict[str, Any]:
    """Return a record with every key that there is, so that a reader never meets a missing one."""
    return {
        "status": status,
        "note": note,
        "root": None if root is None else str(root),
        "folders": [],
        "commit": None,
        "branch": None,
        "remote": None,
        "base": None,
        "tree": None,
        "dirty": None,
        "untracked": [],
        "refused": [],
        "submodules": [],
        "big_files": [],
        "patch": None,
        "patch_bytes": None,
        "patch_sha256": None,
        "content_sha256": None,
    }


def _remote(repository: Repository, branch: str | None) -> dict[str, str] | None:
    """Return name and address of the branch's own remote, else of origin, else of the first there is."""
    names = repository.text("remote").splitlines()
    tracked = repository.maybe("config", f"branch.{branch}.remote") if branch else None
    chosen = next((name for name in (tracked, "origin", *names) if name in names), None)
    if chosen is None:
        return None
    url = repository.maybe("config", f"remote.{chosen}.url") or ""
    return {"name": chosen, "url": without_credentials(url)}


def _refuse_patch(record: dict[str, Any], sizes: dict[str, int], what: str, size: int, cap: int) -> None:
    biggest = sorted(sizes.items(), key=lambda item: (-item[1], item[0]))[:_BIG_FILES_SHOWN]
    record.update(status="patch_too_large", dirty=True)
    record["big_files"] = [{"path": path, "bytes": count} for path, count in biggest]
    names = ", ".join(path for path, _ in biggest[:3])
    record["note"] = (
        f"{what} {size / 1e6:.1f} MB and run.max_patch_mb is {cap / 1e6:g}, so the changes are not kept; "
        f"commit or ignore the big files ({names}), or raise run.max_patch_mb"
    )


def _note(record: dict[str, Any]) -> str | None:
    notes = []
    if record["commit"] is None:
        notes.append("the repository has no commit; the patch makes the tree from nothing")
    if record["refused"]:
        notes.append("left out: " + ", ".join(entry["path"] for entry in record["refused"]))
    if record["submodules"]:
        notes.append("submodules are recorded by their commit alone")
    return "; ".join(notes) or None
