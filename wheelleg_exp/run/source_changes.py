"""Describe a run's recorded source code as text, and list the files that differ between two source trees."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.run.git_commands import OBJECT_ID, GitError, run_git, split_nul

_SHOWN_REASONS = 5
_ABSENT = "000000"

State = str | None  # A file's state is its git mode and blob id as text, or None if the git tree lacks the file.


def source_lines(content: Mapping[str, Any]) -> list[str]:
    """Describe each source repository in a line; add a warning line for a repository with files that are not stored."""
    lines = []
    for record in (content, *content["others"]):
        lines.append(_source_line(record))
        missing = [f"{entry['path']!r} ({entry['reason']})" for entry in record["refused"]]
        missing += [f"{entry['path']!r} (it is a submodule)" for entry in record["submodules"]]
        if missing:
            names = first_few(missing, _SHOWN_REASONS)
            lines.append(f"warning: not captured of the source of {record['root']}: {names}")
    return lines


def _source_line(record: Mapping[str, Any]) -> str:
    if record["patch"] is None:
        warning = "source" if record["status"] == "installed" else "warning: the source is not captured"
        return f"{warning}: {record['note']}"
    patch, count = record["patch"], len(record["changed"])
    files = f"{count} file{'' if count == 1 else 's'}"
    if record["commit"] is None:
        return f"source: {record['root']} has no commit yet; {files}, stored in source/{patch}"
    branch = f" on {record['branch']}" if record["branch"] else ", no branch"
    place = f"source: commit {record['commit'][:10]} of {record['root']}{branch}"
    if not record["dirty"]:
        return f"{place}, clean"
    untracked = f" ({len(record['untracked'])} untracked)" if record["untracked"] else ""
    return f"{place}, with changes: {files}{untracked}, stored in source/{patch}"


def describe_changes(was: Mapping[str, Any], now: Mapping[str, Any], repositories: Iterable[Path]) -> str:
    """Return a text with the source files that differ between two runs, or with the reason why they are unknown."""
    place = str(now.get("root") or was.get("root") or "the source")
    if not (was and now):
        return f"{place}: part of only one of the two sources"
    if was.get("distribution") or now.get("distribution"):
        return f"{place}: installed, {was.get('distribution')} and {now.get('distribution')}"
    before, after = _contents(was), _contents(now)
    if before is None or after is None:
        return f"{place}: the files were not captured, so their differences are unknown"
    between = _between(was.get("base"), now.get("base"), repositories)
    if between is None:
        return f"{place}: the commits differ, and no repository here contains both, so the changed files are unknown"
    return f"{place}: {_compare(before, after, between) or 'no file differs'}"


def changed_states(record: Mapping[str, Any]) -> dict[str, State]:
    """Return git mode and blob id of each file with uncommitted changes, by path; None for a deleted file."""
    return {path: pair[1] for path, pair in (_contents(record) or {}).items()}


def state(mode: str, blob: str) -> State:
    """Return a file's git mode and blob id as one text, or None for a file that does not exist."""
    return None if mode == _ABSENT else f"{mode} {blob}"


def _contents(record: Mapping[str, Any]) -> dict[str, list[State]] | None:
    """Return each changed file's git states in the base commit and in the source tree; None if not recorded."""
    found = record.get("contents")
    valid = isinstance(found, dict) and all(isinstance(pair, list) and len(pair) == 2 for pair in found.values())
    return found if valid else None


def _compare(was: Mapping[str, Any], now: Mapping[str, Any], between: Mapping[str, tuple[State, State]]) -> str:
    """Return a text with the files that were changed, added, or removed; an empty text if no file differs."""

    def state_in(path: str, side: int, own: Mapping[str, Any], other: Mapping[str, Any]) -> Any:
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


def _between(a: Any, b: Any, repositories: Iterable[Path]) -> dict[str, tuple[State, State]] | None:
    """Return both git states of each file that differs between two commits; None if no repository has both commits."""
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


def first_few(names: Sequence[str], shown: int = 3) -> str:
    """Return a text with the first few of the given names and the number of the remaining names."""
    more = len(names) - shown
    return ", ".join(names[:shown]) + (f" and {more} more" if more > 0 else "")
