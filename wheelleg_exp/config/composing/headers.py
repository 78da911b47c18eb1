"""Package lines: which files of a group have one, and a file that lacks the one that its siblings have."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from wheelleg_exp.config.composing.loader import Repository
from wheelleg_exp.config.tree import file_text, show_file
from wheelleg_exp.errors import ConfigError, nearest_name

_HEADER = re.compile(r"^\s*#+\s*@package +(\S+)\s*$")
_MEANT = re.compile(r"^\s*#+\s*@\s*package[ :]+(\S+)\s*$", re.MULTILINE | re.IGNORECASE)
# The only package that a task can have, even when there is no other task.
_ALWAYS = {"task": "_global_"}


def package_header(file: Path) -> str | None:
    """Return the package that a file's first line names, or None."""
    try:
        lines = file_text(file).splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    first = next((line for line in lines if line.strip()), "")
    match = _HEADER.match(first)
    return match.group(1) if match else None


def package_meant(file: Path) -> str | None:
    """Return the package that some line of a file names, be it where Hydra does not look for it."""
    try:
        match = _MEANT.search(file_text(file))
    except (OSError, UnicodeDecodeError):
        return None
    return match.group(1) if match else None


def usual_header(repository: Repository, group: str, without: Path | None = None) -> str | None:
    """Return the package line that the files of a group have, all but one of them; None when they have none."""
    if group in _ALWAYS:
        return _ALWAYS[group]
    folders = [Path(s.path) / group for s in repository.get_sources() if s.scheme() == "file"]
    files = [file for folder in folders for file in sorted(folder.glob("*.yaml")) if file != without]
    headers = [package_header(file) for file in files]
    named = Counter(header for header in headers if header is not None).most_common(1)
    # A file without a line counts for nothing where others agree: it may be the very one that lacks it.
    return named[0][0] if named and named[0][1] * 2 >= len(headers) else None


def _misspelled_headers(repository: Repository) -> list[ConfigError]:
    """Find package lines that are nearly the one of their group."""
    problems = []
    for config_path, loaded in repository.loaded.items():
        group, header = config_path.rpartition("/")[0], package_header(loaded.file)
        if not group or not header or group.startswith("hydra"):
            continue
        usual = usual_header(repository, group, loaded.file)
        if usual and header != usual and nearest_name(header, [usual]):
            line = f"# @package {usual}"
            message = f"this file's package line says '{header}', where nothing reads it"
            where = show_file(loaded.file, 1)
            problems.append(ConfigError(message, key=config_path, where=where, expected=f"'{line}'", nearest=line))
    return problems


def missing_headers(repository: Repository, mounted: Iterable[str]) -> list[ConfigError]:
    """Find files without the package line that their group's files have, or with one that is nearly it.

    Args:
        repository: the repository that has loaded the files.
        mounted: groups that some defaults list or override mounts at a package of its own: they need no line.
    """
    explicit = set(mounted)
    problems = _misspelled_headers(repository)
    for config_path, loaded in repository.loaded.items():
        group = config_path.rpartition("/")[0]
        if not group or group in explicit or group.startswith("hydra") or package_header(loaded.file):
            continue
        usual = usual_header(repository, group)
        if usual is not None:
            problems.append(
                ConfigError(
                    "this file has no package line, so that its keys would land below its group's name",
                    key=config_path,
                    where=show_file(loaded.file, 1),
                    expected=f"'# @package {usual}' as the first line of the file",
                )
            )
    return problems
