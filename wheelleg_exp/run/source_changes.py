"""Name the files that differ between two recorded source trees, and summarize a recorded source for the console."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wheelleg_exp.run.git_commands import OBJECT_ID, GitError, run_git, split_nul

_SHOWN_REFUSALS = 5


def source_lines(content: Mapping[str, Any]) -> list[str]:
    """Return one line for each repository or folder of a ``git.json``, and one more for those that leave files out.

    Args:
        content: what ``restore.load_source`` returns.
    """
    lines = []
    for record in (content, *content["others"]):
        lines.append(_source_line(record))
        if record["refused"]:
            lines.append(f"warning: left out of the source of {record['root']}: {_refusals(record['refused'])}")
    return lines


def _source_line(record: Mapping[str, Any]) -> str:
    if record["patch"] is not None:
        return f"source: {_stored(record)}"
    if record["status"] == "installed":
        return f"source: {record['note']}"
    return f"warning: the source is not kept: {record['note']}"


def _stored(record: Mapping[str, Any]) -> str:
    patch, count = record["patch"], len(record["changed"])
    files = f"{count} file{'' if count == 1 else 's'}"
    if record["commit"] is None:
        where = "has no commit yet" if record["status"] == "no_commits" else "is in no repository that git reads"
        return f"{record['root']} {where}; {files}, kept in source/{patch}"
    place = f"commit {record['commit'][:10]} of {record['root']}"
    branch = f" on {record['branch']}" if record["branch"] else ", no branch"
    if not record["dirty"]:
        return f"{place}{branch}, clean"
    untracked = f" ({len(record['untracked'])} untracked)" if record["untracked"] else ""
    return f"{place}{branch}, with changes: {files}{untracked}, kept in source/{patch}"


def _refusals(entries: list[Mapping[str, str]]) -> str:
    shown = [f"{entry['path']!r} ({entry['reason']})" for entry in entries[:_SHOWN_REFUSALS]]
    more = len(entries) - _SHOWN_REFUSALS
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


_SHOWN = 3
_ABSENT = "000000"

State = str | None  # mode and blob id of a path, None where it is absent


@dataclass(frozen=True)
class FileChanges:
    """The paths in which two trees differ, sorted."""

    added: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        kinds = ((self.changed, "changed"), (self.added, "added"), (self.removed, "removed"))
        return "; ".join(f"{word} {_first_paths(paths)}" for paths, word in kinds if paths)


def describe_changes(was: Mapping[str, Any], now: Mapping[str, Any], repositories: Iterable[Path]) -> str:
    """Return which files differ between two records of ``git.json``, or why that cannot be told.

    Args:
        was: the earlier record, or A's.
        now: the later one, or B's.
        repositories: folders whose repository may hold both commits; git is asked there.
    """
    place = str(now.get("root") or was.get("root") or "the source")
    if not (was and now):
        return f"{place}: part of one of the sources alone"
    if was.get("distribution") or now.get("distribution"):
        return f"{place}: installed, {was.get('distribution')} and {now.get('distribution')}"
    before, after = _contents(was), _contents(now)
    if before is None or after is None:
        return f"{place}: which files differ was not recorded"
    between = _between(was.get("base"), now.get("base"), repositories)
    if between is None:
        return f"{place}: another commit, and no repository here holds both: which files differ cannot be told"
    return f"{place}: {_compare(before, after, between) or 'no file differs'}"


def states(record: Mapping[str, Any]) -> dict[str, State]:
    """Return the states in a record's tree of the paths that differ from its base, None for those that are gone."""
    return {path: pair[1] for path, pair in (_contents(record) or {}).items()}


def _contents(record: Mapping[str, Any]) -> dict[str, list[State]] | None:
    """Return the states in base and tree of the paths that differ, as recorded."""
    found = record.get("contents")
    right = isinstance(found, dict) and all(isinstance(pair, list) and len(pair) == 2 for pair in found.values())
    return found if right else None


def state(mode: str, blob: str) -> State:
    """Return the state of a path with git's mode and blob id."""
    return None if mode == _ABSENT else f"{mode} {blob}"


def _compare(
    was: Mapping[str, Any], now: Mapping[str, Any], between: Mapping[str, tuple[State, State]]
) -> FileChanges | None:
    found = FileChanges()
    for path in sorted({*was, *now, *between}):
        old, new = _state(path, 0, was, now, between), _state(path, 1, now, was, between)
        if old != new:
            (found.added if old is None else found.removed if new is None else found.changed).append(path)
    return found if found != FileChanges() else None


def _state(path: str, side: int, own: Any, other: Any, between: Mapping[str, tuple[State, State]]) -> Any:
    """Return a path's state in one of the trees: as changed there, else as in its base."""
    if path in own:
        return own[path][1]
    return between[path][side] if path in between else other[path][0]  # of a path that both bases have alike


def _between(a: Any, b: Any, repositories: Iterable[Path]) -> dict[str, tuple[State, State]] | None:
    """Return the states of the paths that differ between two commits or trees; None when no repository holds both."""
    if a == b:
        return {}
    if not all(isinstance(base, str) and OBJECT_ID.fullmatch(base) for base in (a, b)):
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


def _first_paths(paths: list[str]) -> str:
    more = len(paths) - _SHOWN
    return ", ".join(paths[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
