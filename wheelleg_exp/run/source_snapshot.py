"""Store the state of the source tree with the run: a commit, a tree id, and a patch that restores the tree.

``git.json`` describes the repository of each source folder, the main one first. ``source.patch`` contains all changes
since the commit, including untracked and binary files; ``source_2.patch`` is that of a second repository. Ignored files
and the folder of runs are not stored. ``git.json`` lists what else is missing (submodules, nested repositories, folders
without git, and files with a git filter such as Git LFS), and then contains ``exact: false``.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Literal

from wheelleg_exp.files import sha256, write_bytes, write_json
from wheelleg_exp.run import git_commands as git
from wheelleg_exp.run.git_commands import GitError, Repository
from wheelleg_exp.run.source_changes import NotCaptured, SourceRecord, Submodule, state

SOURCE_FORMAT = 1
PATCH_NAME, RECORD_NAME = "source.patch", "git.json"

Status = Literal["ok", "no_commits", "no_repository", "installed", "patch_too_large", "no_git", "failed"]

_BIG_FILES_SHOWN = 20
_INSTALL_FOLDERS = ("site-packages", "dist-packages")
_GITLINK, _NO_MODE = "160000", "000000"


def snapshot_source(
    roots: Sequence[Path], folder: Path, *, runs_root: Path | None = None, max_patch_mb: float = 50.0
) -> list[SourceRecord]:
    """Write ``git.json`` and the patches into the run's ``source`` folder, and return the records of ``git.json``.

    ``roots`` contains source folders and files, first that of ``wheelleg_exp``; each of their repositories gets a
    record. Untracked files in ``runs_root`` are not stored. ``max_patch_mb`` (10^6 bytes) limits the patch, and the
    untracked files, of each repository. If git fails, the run continues, and ``git.json`` contains a status and a note.
    """
    records: list[SourceRecord] = []
    for repository, record in _group(roots):
        patch = None if repository is None else _snapshot(repository, record, runs_root, int(max_patch_mb * 1e6))
        if patch is not None:
            record.patch = PATCH_NAME if not records else f"source_{len(records) + 1}.patch"
            write_bytes(folder / record.patch, patch)
        records.append(record)
    if not records:
        records.append(_record("no_repository", None, "no source folder was given"))
    first, *others = map(asdict, records)
    write_json(folder / RECORD_NAME, {"format": SOURCE_FORMAT, **first, "others": others})
    return records


def _record(status: Status, root: Path | None, note: str | None) -> SourceRecord:
    return SourceRecord(status, note=note, root=None if root is None else str(root))


def is_installed(root: Path, above: Path | None = None) -> bool:
    """Return whether ``root`` is in a ``site-packages`` folder; if ``above`` is given, look only below ``above``."""
    parts = root.parts if above is None else root.relative_to(above).parts
    return any(part in _INSTALL_FOLDERS for part in parts)


def content_digest(root: Path) -> str:
    """Return one sha256 over the names and contents of all readable files at ``root``, except Python bytecode."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if path.is_file() and "__pycache__" not in path.parts and os.access(path, os.R_OK):
            digest.update(os.fsencode(path.relative_to(root)) + b"\0" + sha256(path).encode() + b"\n")
    return digest.hexdigest()


def _group(roots: Iterable[Path]) -> list[tuple[Repository | None, SourceRecord]]:
    """Group source folders by git repository; a folder outside git has a record that says why it is not stored."""
    groups: dict[Path, tuple[Repository | None, SourceRecord]] = {}
    for root in dict.fromkeys(Path(root).resolve() for root in roots):
        repository, record = _place(root)
        known = groups.setdefault(repository.top if repository else root, (repository, record))[1]
        if known is not record:
            known.folders += record.folders
    return list(groups.values())


def _place(root: Path) -> tuple[Repository | None, SourceRecord]:
    """Return the git repository of ``root``, or None and the reason why the files of ``root`` cannot be stored."""
    folder = root if root.is_dir() else root.parent
    try:
        found = git.run_git(folder, "rev-parse", "--show-toplevel")
        repository = Repository(Path(os.fsdecode(found).removesuffix("\n")))
    except GitError as error:
        if is_installed(root):
            return None, _installed(root)
        if isinstance(error, git.GitMissing):
            return None, _record("no_git", root, "git is not installed, so the source is not captured")
        return None, _not_captured(root, str(error))
    top = repository.top.resolve()
    if not root.is_relative_to(top):
        return None, _not_captured(root, f"the repository of '{root}' has its working tree in '{repository.top}'")
    if is_installed(root, top):
        return None, _installed(root)
    if root != top and repository.maybe("check-ignore", "--", str(root)) is not None:
        return None, _not_captured(root, f"'{root}' is ignored by the repository around it")
    record = _record("ok", repository.top, None)
    record.folders = [root.relative_to(top).as_posix()]
    return repository, record


def _not_captured(root: Path, reason: str) -> SourceRecord:
    status: Status = "no_repository"
    if "not a git repository" in reason:
        reason = f"'{root}' is not in a git repository"
    elif "dubious ownership" in reason:
        reason = f"git refuses the repository of '{root}', because it belongs to another user"
    elif reason.startswith("git failed"):
        status = "failed"
    return _record(status, root, f"{reason}, so its files are not captured")


def _installed(root: Path) -> SourceRecord:
    # Find ``name==version`` of the installed package that contains ``root``.
    place = next((place for place in root.parents if place.name in _INSTALL_FOLDERS), root)
    top, packages = root.relative_to(place).parts[:1], metadata.distributions(path=[str(place)])
    owners = (package for package in packages if any(file.parts[:1] == top for file in package.files or ()))
    name = next((f"{owner.metadata['Name']}=={owner.version}" for owner in owners), None)
    note = f"'{root}' is installed{f' ({name})' if name else ''}: its digest is stored, not its files"
    digest = content_digest(root)
    return SourceRecord("installed", note=note, root=str(root), distribution=name, content_sha256=digest)


def _snapshot(repository: Repository, record: SourceRecord, runs_root: Path | None, cap: int) -> bytes | None:
    """Complete a repository's ``record``; return its patch, or None if the patch is too large or git fails."""
    try:
        commit = repository.maybe("rev-parse", "--verify", "--quiet", "HEAD")
        record.status = "ok" if commit else "no_commits"
        record.commit = commit
        base = record.base = commit or repository.text("hash-object", "-t", "tree", os.devnull)
        record.branch = repository.maybe("symbolic-ref", "-q", "--short", "HEAD")
        # Store the URL of the current branch's git remote, otherwise of ``origin``, otherwise of the first git remote.
        names = repository.text("remote").splitlines()
        tracked = repository.maybe("config", f"branch.{record.branch}.remote") if record.branch else None
        chosen = next((name for name in (tracked, "origin", *names) if name in names), None)
        if chosen is not None:
            url = git.without_credentials(repository.maybe("config", f"remote.{chosen}.url") or "")
            record.remote = {"name": chosen, "url": url}
        record.shallow = repository.text("rev-parse", "--is-shallow-repository") == "true"
        return _capture(repository, record, base, runs_root, cap)
    except GitError as error:
        record.status, record.note = "failed", f"the files are not captured: {error}"
        return None


def _capture(repository: Repository, record: SourceRecord, base: str, runs_root: Path | None, cap: int) -> bytes | None:
    """Add the git tree id to ``record``; return the patch of uncommitted changes, or None if the patch is too large."""
    untracked, refused = _untracked_files(repository, runs_root)
    record.refused = list(refused)
    sizes = _sizes(repository, untracked)
    if sum(sizes.values()) > cap:
        _refuse_patch(record, sizes, "the untracked files have", sum(sizes.values()), cap)
        return None
    with git.scratch_index(repository) as scratch:
        filtered = _filtered(repository, repository.paths("ls-files", "-z"))
        refused += filtered + _add_working_tree(scratch, untracked)
        parts = scratch.paths("diff-index", "--cached", "--raw", "--no-renames", "--no-abbrev", "-z", base)
        # The modes and blob ids of each changed path in the base and in the index; zeros for a missing side.
        facts = (entry.removeprefix(":").split(" ") for entry in parts[::2])
        changes = {path: (*fields[:4],) for path, fields in zip(parts[1::2], facts, strict=True)}
        # In the temporary index, restore the committed version of files with a git filter; mode 0 removes a file.
        names = {entry["path"] for entry in filtered}
        reset = [(path, mode, blob) for path, (mode, _, blob, _) in changes.items() if path in names]
        lines = [f"{'0' if mode == _NO_MODE else mode} {blob}\t{path}" for path, mode, blob in reset]
        if lines:
            scratch.run("update-index", "-z", "--index-info", stdin=git.join_nul(lines))
        left_out = {entry["path"] for entry in refused}
        record.refused = list(refused)
        record.untracked = [path for path in untracked if path not in left_out]
        stored = {path: change for path, change in changes.items() if path not in left_out}
        record.changed = list(stored)
        record.contents = {path: (state(c[0], c[2]), state(c[1], c[3])) for path, c in stored.items()}
        record.dirty = bool(changes) or len(refused) > len(filtered)
        record.submodules = _submodules(scratch)
        record.tree = scratch.text("write-tree")
        # Make a patch from the commit ``base`` to the temporary git index, regardless of the user's git diff settings.
        options = ["--cached", "-p", "--binary", "--full-index", "--no-renames", "--no-color", "--no-ext-diff"]
        options += ["--no-textconv", "--src-prefix=a/", "--dst-prefix=b/", "--submodule=short"]
        options += ["--ignore-submodules=none", "--no-relative", "-U3"]
        patch = scratch.run("diff-index", *options, base)
        if len(patch) > cap:
            present = [path for path, change in stored.items() if change[1] not in (_NO_MODE, _GITLINK)]
            _refuse_patch(record, _sizes(repository, present), "the patch has", len(patch), cap)
            return None
    notes = ["the repository has no commit, so the patch contains the whole tree"] if record.commit is None else []
    for what, entries in (("files", record.refused), ("submodules", record.submodules)):
        if entries:
            notes.append(f"{what} not captured: {', '.join(entry['path'] for entry in entries)}")
    record.patch_bytes, record.patch_sha256 = len(patch), hashlib.sha256(patch).hexdigest()
    record.note = "; ".join(notes) or None
    record.exact = not (record.refused or record.submodules)
    return patch


def _untracked_files(repository: Repository, runs_root: Path | None) -> tuple[list[str], list[NotCaptured]]:
    """Return two lists: the untracked files to store, and the untracked files that cannot be stored, with reasons."""
    # Skip a file to which the process prints its output, because the file grows during the run.
    runs, top = None if runs_root is None else runs_root.resolve(), repository.top.resolve()
    runs = runs.relative_to(top) if runs is not None and runs != top and runs.is_relative_to(top) else None
    paths = repository.paths("ls-files", "--others", "--exclude-standard", "-z")
    # Find the device and inode of the files that receive this process's standard output and standard error.
    output = set()
    for descriptor in (1, 2):
        with suppress(OSError):
            written = os.fstat(descriptor)
            output |= {(written.st_dev, written.st_ino)} if stat.S_ISREG(written.st_mode) else set()
    refused = _filtered(repository, paths)
    filtered, captured = {entry["path"] for entry in refused}, []
    for path in paths:
        full = repository.top / path
        facts = _lstat(full)
        is_output = facts is not None and (facts.st_dev, facts.st_ino) in output
        if is_output or (runs is not None and Path(path).is_relative_to(runs)) or path in filtered:
            continue
        if path.endswith("/"):
            refused.append(NotCaptured(path=path, reason="it is a repository of its own"))
        elif not full.is_symlink() and full.exists() and not os.access(full, os.R_OK):
            refused.append(NotCaptured(path=path, reason="it cannot be read"))
        else:
            captured.append(path)
    return captured, refused


def _lstat(path: Path) -> os.stat_result | None:
    try:
        return path.lstat()
    except OSError:
        return None


def _sizes(repository: Repository, paths: Iterable[str]) -> dict[str, int]:
    facts = {path: _lstat(repository.top / path) for path in paths}
    return {path: 0 if found is None else found.st_size for path, found in facts.items()}


def _filtered(repository: Repository, paths: list[str]) -> list[NotCaptured]:
    """Return the files that git passes through a filter program, such as Git LFS or an encryption program."""
    # To store a file with a git filter, git would run the filter program, so source snapshots omit such files.
    programs = git.filters(repository)
    if not programs or not paths:
        return []
    parts = git.split_nul(repository.run("check-attr", "-z", "--stdin", "filter", stdin=git.join_nul(paths)))
    found = zip(parts[::3], parts[2::3], strict=True)
    return [
        NotCaptured(path=path, reason=f"git passes it through the filter '{name}'")
        for path, name in found
        if name in programs
    ]


def _add_working_tree(scratch: Repository, untracked: list[str]) -> list[NotCaptured]:
    """Add all files of the working tree to a temporary git index; return the changed files that git cannot read."""
    # Make git compare even the files that the user marked with assume-unchanged or skip-worktree.
    tagged = [(entry[0], entry[2:]) for entry in scratch.paths("ls-files", "-v", "-z")]
    here = [(tag, path) for tag, path in tagged if os.path.lexists(scratch.top / path)]
    assumed = [path for tag, path in here if tag.islower()]
    skipped = [path for tag, path in here if tag in "Ss"]
    for flag, paths in (("--no-assume-unchanged", assumed), ("--no-skip-worktree", skipped)):
        if paths:
            scratch.run("update-index", flag, "-z", "--stdin", stdin=git.join_nul(paths))
    # Exclude submodules, because ``git add`` would run their filter programs.
    others = ["--", ".", *(f":(exclude,literal){entry['path']}" for entry in _submodules(scratch))]
    refused: list[NotCaptured] = []
    try:
        scratch.run("add", "-u", *others)
    except GitError:
        try:
            scratch.run("add", "-u", "--ignore-errors", *others)
        except GitError as error:
            left = scratch.paths("diff-files", "--name-only", "--ignore-submodules=all", "-z")
            if not left:
                raise
            refused = [NotCaptured(path=path, reason=f"git cannot read it: {error}") for path in left]
    # With --remove, `git update-index` accepts files that were deleted after `git ls-files` had listed them.
    scratch.run("update-index", "--add", "--remove", "--replace", "-z", "--stdin", stdin=git.join_nul(untracked))
    return refused


def _submodules(scratch: Repository) -> list[Submodule]:
    entries = (entry.split("\t", 1) for entry in scratch.paths("ls-files", "--stage", "-z"))
    found = ((facts.split(" "), path) for facts, path in entries)
    return [Submodule(path=path, commit=commit) for (mode, commit, _), path in found if mode == _GITLINK]


def _refuse_patch(record: SourceRecord, sizes: dict[str, int], what: str, size: int, cap: int) -> None:
    biggest = sorted(sizes.items(), key=lambda item: (-item[1], item[0]))[:_BIG_FILES_SHOWN]
    record.status, record.dirty = "patch_too_large", True
    record.big_files = [{"path": path, "bytes": count} for path, count in biggest]
    names = ", ".join(path for path, _ in biggest[:3])
    note = f"{what} {size / 1e6:.1f} MB and run.max_patch_mb is {cap / 1e6:g}, so the changes are not stored; "
    record.note = note + f"commit or ignore the big files ({names}), or raise run.max_patch_mb"
