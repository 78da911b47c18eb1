"""Describe a run's recorded source code as text, and list the files that differ between two source trees."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from wheelleg_exp.run.git_commands import OBJECT_ID, GitError, run_git, split_nul

_SHOWN_REASONS = 5
_ABSENT = "000000"

State = str | None  # A file's state is its git mode and blob id as text, or None if the git tree lacks the file.
States = tuple[State, State]  # A file's states before and after a change.


class NotCaptured(TypedDict):
    """A file whose content is not in the source snapshot, and the reason why not."""

    path: str
    reason: str


class Submodule(TypedDict):
    """A git submodule, whose files are not in the source snapshot, and its commit."""

    path: str
    commit: str


class Remote(TypedDict, total=False):
    """A git remote."""

    name: str | None
    url: str | None


@dataclass
class SourceRecord:
    """The state of one source repository, as in ``git.json``; None for a value that is not known.

    The repository has a ``patch`` only if its ``status`` is ``ok`` or ``no_commits``; otherwise, ``note`` says why not.
    ``base`` is the commit or the empty tree to which the patch applies. ``contents`` maps each changed file to its
    states in ``base`` and in the source tree. ``content_sha256`` is the digest of an installed package.
    """

    status: str = ""
    exact: bool = False
    note: str | None = None
    root: str | None = None
    folders: list[str] = field(default_factory=list)
    commit: str | None = None
    branch: str | None = None
    remote: Remote | None = None
    shallow: bool | None = None
    base: str | None = None
    tree: str | None = None
    dirty: bool | None = None
    untracked: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    contents: Mapping[str, States] | None = None
    refused: list[NotCaptured] = field(default_factory=list)
    submodules: list[Submodule] = field(default_factory=list)
    big_files: list[object] = field(default_factory=list)
    patch: str | None = None
    patch_bytes: int | None = None
    patch_sha256: str | None = None
    distribution: str | None = None
    content_sha256: str | None = None


def source_lines(records: Iterable[SourceRecord]) -> list[str]:
    """Describe each source repository in a line; add a warning line for a repository with files that are not stored."""
    lines = []
    for record in records:
        lines.append(_source_line(record))
        missing = [f"{entry['path']!r} ({entry['reason']})" for entry in record.refused]
        missing += [f"{entry['path']!r} (it is a submodule)" for entry in record.submodules]
        if missing:
            names = first_few(missing, _SHOWN_REASONS)
            lines.append(f"warning: not captured of the source of {record.root}: {names}")
    return lines


def _source_line(record: SourceRecord) -> str:
    if record.patch is None:
        warning = "source" if record.status == "installed" else "warning: the source is not captured"
        return f"{warning}: {record.note}"
    patch, count = record.patch, len(record.changed)
    files = f"{count} file{'' if count == 1 else 's'}"
    if record.commit is None:
        return f"source: {record.root} has no commit yet; {files}, stored in source/{patch}"
    branch = f" on {record.branch}" if record.branch else ", no branch"
    place = f"source: commit {record.commit[:10]} of {record.root}{branch}"
    if not record.dirty:
        return f"{place}, clean"
    untracked = f" ({len(record.untracked)} untracked)" if record.untracked else ""
    return f"{place}, with changes: {files}{untracked}, stored in source/{patch}"


def describe_changes(was: SourceRecord | None, now: SourceRecord | None, repositories: Iterable[Path]) -> str:
    """Return a text with the source files that differ between two runs, or with the reason why they are unknown."""
    place = (now and now.root) or (was and was.root) or "the source"
    if was is None or now is None:
        return f"{place}: part of only one of the two sources"
    if was.distribution or now.distribution:
        return f"{place}: installed, {was.distribution} and {now.distribution}"
    if was.contents is None or now.contents is None:
        return f"{place}: the files were not captured, so their differences are unknown"
    between = _between(was.base, now.base, repositories)
    if between is None:
        return f"{place}: the commits differ, and no repository here contains both, so the changed files are unknown"
    return f"{place}: {_compare(was.contents, now.contents, between) or 'no file differs'}"


def state(mode: str, blob: str) -> State:
    """Return a file's git mode and blob id as one text, or None for a file that does not exist."""
    return None if mode == _ABSENT else f"{mode} {blob}"


def _compare(was: Mapping[str, States], now: Mapping[str, States], between: Mapping[str, States]) -> str:
    """Return a text with the files that were changed, added, or removed; an empty text if no file differs."""

    def state_in(path: str, side: int, own: Mapping[str, States], other: Mapping[str, States]) -> State:
        if path in own:
            return own[path][1]
        # If ``between`` lacks a file, the file is equal in both git commits.
        return between[path][side] if path in between else other[path][0]

    found: dict[str, list[str]] = {"changed": [], "added": [], "removed": []}
    for path in sorted({*was, *now, *between}):
        old, new = state_in(path, 0, was, now), state_in(path, 1, now, was)
        if old != new:
            found["added" if old is None else "removed" if new is None else "changed"].append(path)
    return "; ".join(f"{kind} {first_few(paths)}" for kind, paths in found.items() if paths)


def _between(a: str | None, b: str | None, repositories: Iterable[Path]) -> dict[str, States] | None:
    """Return both git states of each file that differs between two commits; None if no repository has both commits."""
    if a == b:
        return {}
    if not (a and b and OBJECT_ID.fullmatch(a) and OBJECT_ID.fullmatch(b)):
        return None
    for folder in dict.fromkeys(repositories):
        try:
            output = run_git(folder, "diff-tree", "-r", "--raw", "--no-renames", "--no-abbrev", "-z", a, b)
        except GitError:
            continue
        parts = split_nul(output)
        facts = (entry.removeprefix(":").split(" ") for entry in parts[::2])
        return {path: (state(f[0], f[2]), state(f[1], f[3])) for f, path in zip(facts, parts[1::2], strict=True)}
    return None


def first_few(names: Sequence[str], shown: int = 3) -> str:
    """Return a text with the first few of the given names and the number of the remaining names."""
    more = len(names) - shown
    return ", ".join(names[:shown]) + (f" and {more} more" if more > 0 else "")
