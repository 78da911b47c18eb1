"""What of a working tree is kept: all but ignored files, runs, and what looks like a key or a token."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.run.source.git import GitError, Repository, filters, join_nul, split_nul
from wheelleg_exp.run.source.secrecy import secret_content, secret_name

# A filter that only moves content elsewhere: with it off, git keeps the content itself.
_HARMLESS_FILTERS = ("lfs",)
_VIRTUAL_ENVIRONMENT = "pyvenv.cfg"

_GITLINK = "160000"
_NONE = "000000"


@dataclass(frozen=True)
class Refused:
    """A file whose state is not kept, and why."""

    path: str
    reason: str


@dataclass(frozen=True)
class ChangedPath:
    """How one path of the index differs from the base: modes and blob ids, zeros for none."""

    path: str
    old_mode: str
    old_id: str
    new_mode: str
    new_id: str

    def blobs(self) -> list[str]:
        """Return the ids of the contents before and after, as far as there are any."""
        sides = ((self.old_mode, self.old_id), (self.new_mode, self.new_id))
        return [blob for mode, blob in sides if mode not in (_NONE, _GITLINK)]


def untracked_files(repository: Repository, runs_root: Path | None) -> tuple[list[str], list[Refused]]:
    """Return the untracked files to keep, and those refused; ignored files and runs are in neither.

    Nor is the output of this process where it goes to a file. A virtual environment is refused as a whole.
    """
    kept: list[str] = []
    runs = _relative_to_top(repository, runs_root)
    paths = repository.paths("ls-files", "--others", "--exclude-standard", "-z")
    environments = {p.removesuffix(_VIRTUAL_ENVIRONMENT) for p in paths if p.endswith(f"/{_VIRTUAL_ENVIRONMENT}")}
    refused = [Refused(folder, "it is a virtual environment") for folder in sorted(environments)]
    filtered, output = _filtered(repository, paths), _output_files()
    for path in paths:
        if output and _identity(repository.top / path) in output:
            continue
        if runs is not None and Path(path).is_relative_to(runs):
            continue
        if any(path.startswith(folder) for folder in environments):
            continue
        reason = _reason_against(repository, path) or filtered.get(path)
        if reason is None:
            kept.append(path)
        else:
            refused.append(Refused(path, reason))
    return kept, refused


def _output_files() -> set[tuple[int, int]]:
    """Return the identities of the files that this process and its parent print to; a sweep prints for its jobs.

    What goes through a pipe, as to ``tee``, cannot be seen.
    """
    printed = [Path(f"/proc/{pid}/fd/{number}") for pid in (os.getpid(), os.getppid()) for number in (1, 2)]
    found = {_identity(path, follow=True) for path in printed}
    for number in (1, 2):
        with suppress(OSError):
            found.add(_identity_of(os.fstat(number)))
    return {identity for identity in found if identity is not None}


def _identity(path: Path, *, follow: bool = False) -> tuple[int, int] | None:
    try:
        return _identity_of(path.stat() if follow else path.lstat())
    except OSError:
        return None


def _identity_of(facts: os.stat_result) -> tuple[int, int] | None:
    return (facts.st_dev, facts.st_ino) if stat.S_ISREG(facts.st_mode) else None


def file_sizes(repository: Repository, paths: list[str]) -> dict[str, int]:
    """Return the sizes in bytes; 0 for a file that is gone by now."""
    sizes = {}
    for path in paths:
        try:
            sizes[path] = (repository.top / path).lstat().st_size
        except OSError:
            sizes[path] = 0
    return sizes


def add_everything(scratch: Repository, untracked: list[str]) -> list[Refused]:
    """Bring a scratch index to the state of the working tree; return the changed files that git cannot read."""
    _forget_promises(scratch)
    refused = _add_tracked(scratch)
    # --remove, because a file may be gone again by now.
    scratch.run("update-index", "--add", "--remove", "--replace", "-z", "--stdin", stdin=join_nul(untracked))
    return refused


def _add_tracked(scratch: Repository) -> list[Refused]:
    """Bring what is tracked to the state of the working tree.

    Submodules are left out and set to their commits by themselves: git would run their filters to know their state.
    """
    nested = [entry["path"] for entry in submodules(scratch)]
    others = ["--", ".", *(f":(exclude,literal){path}" for path in nested)] if nested else []
    if nested:
        scratch.run("update-index", "--remove", "-z", "--stdin", stdin=join_nul(nested))
    try:
        scratch.run("add", "-u", *others)
    except GitError:
        try:
            scratch.run("add", "-u", "--ignore-errors", *others)
        except GitError as error:
            left = scratch.paths("diff-files", "--name-only", "--ignore-submodules=all", "-z")
            if not left:
                raise
            return [Refused(path, f"git cannot read it: {error}") for path in left]
    return []


def changes_from(scratch: Repository, base: str) -> list[ChangedPath]:
    """Return how the index differs from a commit or tree."""
    parts = scratch.paths("diff-index", "--cached", "--raw", "--no-renames", "--no-abbrev", "-z", base)
    changes = []
    for facts, path in zip(parts[::2], parts[1::2], strict=True):
        old_mode, new_mode, old_id, new_id, _ = facts.removeprefix(":").split(" ")
        changes.append(ChangedPath(path, old_mode, old_id, new_mode, new_id))
    return changes


def refuse_secrets(scratch: Repository, changes: list[ChangedPath]) -> list[Refused]:
    """Set changes that would show a key or a token back to the base, and return them.

    Both sides of a change count, because a removed line stands in a patch as well.
    """
    contents = scratch.blobs([blob for change in changes for blob in change.blobs()])
    filtered = _filtered(scratch, [change.path for change in changes])
    refused: list[Refused] = []
    lines = []
    for change in changes:
        shown = (secret_content(contents[blob]) for blob in change.blobs())
        reason = secret_name(change.path) or filtered.get(change.path) or next(filter(None, shown), None)
        if reason is not None:
            refused.append(Refused(change.path, reason))
            # Mode 0 removes the path from the index.
            mode = "0" if change.old_mode == _NONE else change.old_mode
            lines.append(f"{mode} {change.old_id}\t{change.path}")
    if lines:
        scratch.run("update-index", "-z", "--index-info", stdin=join_nul(lines))
    return refused


def new_sizes(scratch: Repository, changes: list[ChangedPath]) -> dict[str, int]:
    """Return the sizes in bytes of the changed files' new contents."""
    present = {c.path: c.new_id for c in changes if c.new_mode not in (_NONE, _GITLINK)}
    contents = scratch.blobs(list(present.values()))
    return {path: len(contents[blob]) for path, blob in present.items()}


def patch_from(scratch: Repository, base: str) -> bytes:
    """Return the patch that makes the index's tree from ``base``, whatever the user's diff settings are."""
    options = ["--cached", "-p", "--binary", "--full-index", "--no-renames", "--no-color", "--no-ext-diff"]
    options += ["--no-textconv", "--src-prefix=a/", "--dst-prefix=b/", "--submodule=short"]
    options += ["--ignore-submodules=none", "--no-relative", "-U3"]
    return scratch.run("diff-index", *options, base)


def submodules(scratch: Repository) -> list[dict[str, str]]:
    """Return path and commit of every submodule and nested repository in the index."""
    found = []
    for entry in scratch.paths("ls-files", "--stage", "-z"):
        facts, path = entry.split("\t", 1)
        mode, commit, _ = facts.split(" ")
        if mode == _GITLINK:
            found.append({"path": path, "commit": commit})
    return found


def _relative_to_top(repository: Repository, folder: Path | None) -> Path | None:
    if folder is None:
        return None
    full, top = folder.resolve(), repository.top.resolve()
    return full.relative_to(top) if full != top and full.is_relative_to(top) else None


def _filtered(repository: Repository, paths: list[str]) -> dict[str, str]:
    """Return why files that pass through a filter program on their way into git are refused.

    Such a program may encrypt them, or drop what must not be seen.
    """
    programs = [name for name in filters(repository) if name not in _HARMLESS_FILTERS]
    if not programs or not paths:
        return {}
    output = repository.run("check-attr", "-z", "--stdin", "filter", stdin=join_nul(paths))
    parts = split_nul(output)
    found = zip(parts[::3], parts[2::3], strict=True)
    return {path: f"the filter '{name}' stands between it and git" for path, name in found if name in programs}


def _reason_against(repository: Repository, path: str) -> str | None:
    if path.endswith("/"):
        return "it is a repository of its own"
    full = repository.top / path
    if not full.is_symlink() and full.exists() and not os.access(full, os.R_OK):
        return "it cannot be read"
    return secret_name(path)


def _forget_promises(scratch: Repository) -> None:
    """Look again at files that the user told git to take for unchanged (assume-unchanged, skip-worktree)."""
    tagged = [(entry[0], entry[2:]) for entry in scratch.paths("ls-files", "-v", "-z")]
    here = [(tag, path) for tag, path in tagged if os.path.lexists(scratch.top / path)]
    assumed = [path for tag, path in here if tag.islower()]
    skipped = [path for tag, path in here if tag in "Ss"]
    for flag, paths in (("--no-assume-unchanged", assumed), ("--no-skip-worktree", skipped)):
        if paths:
            scratch.run("update-index", flag, "-z", "--stdin", stdin=join_nul(paths))
