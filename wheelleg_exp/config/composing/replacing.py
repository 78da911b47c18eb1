"""Files of the same name in several config folders: one may take another's place, but has to say so.

``# @replaces reward/alive`` in the head of ``my_configs/reward/alive.yaml`` says that it stands for the stock file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.config.tree import file_text, show_file
from wheelleg_exp.errors import ConfigError

_MARK = re.compile(r"^\s*#\s*@\s*replaces\b[ :]*(.*?)\s*$", re.IGNORECASE)


def replaced_by(file: Path) -> tuple[str, int] | None:
    """Return the config that a file says it replaces, and the line on which it does; None when it does not."""
    try:
        lines = file_text(file).splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith("#"):
            return None
        match = _MARK.match(line)
        if match is not None:
            return match.group(1), number
    return None


def chosen_file(config_path: str, files: Sequence[Path]) -> Path:
    """Return the file that is read for a config: the one that says it replaces the others' only one, or the only one.

    Args:
        config_path: the config, such as ``reward/alive``.
        files: the files of that name along the search path, at least one.

    Raises:
        ConfigError: a file would never be read, several replace one, or a file replaces nothing.
    """
    different = list({file.resolve(): file for file in reversed(files)}.values())[::-1]
    marks = {file: replaced_by(file) for file in different}
    for file, mark in marks.items():
        if mark is not None and mark[0] != config_path:
            raise _wrong_mark(config_path, file, mark)
    plain = [file for file in different if marks[file] is None]
    replacing = [file for file in different if marks[file] is not None]
    if len(plain) > 1:
        raise _hidden(config_path, plain)
    if len(replacing) > 1:
        raise _contested(config_path, replacing, marks)
    if not plain:
        raise _replaces_nothing(config_path, replacing[0], marks)
    return replacing[0] if replacing else files[0]


def _hidden(config_path: str, plain: Sequence[Path]) -> ConfigError:
    return ConfigError(
        f"this file is never read, because {show_file(plain[0])} has the same name",
        key=config_path,
        where=show_file(plain[1]),
        expected="a name that no stock config and no other config folder has, "
        f"or the line '# @replaces {config_path}' in its head, to take the other's place on purpose",
    )


def _contested(config_path: str, replacing: Sequence[Path], marks: dict[Path, tuple[str, int] | None]) -> ConfigError:
    return ConfigError(
        f"this file and {show_file(replacing[0])} both replace '{config_path}'",
        key=config_path,
        where=_place(replacing[1], marks[replacing[1]]),
        expected="one file that replaces it",
    )


def _replaces_nothing(config_path: str, file: Path, marks: dict[Path, tuple[str, int] | None]) -> ConfigError:
    return ConfigError(
        f"there is no other '{config_path}' that this file could replace",
        key=config_path,
        where=_place(file, marks[file]),
        expected="a file without that line, or with the name of the one that it replaces",
    )


def _wrong_mark(config_path: str, file: Path, mark: tuple[str, int]) -> ConfigError:
    return ConfigError(
        f"this file says that it replaces '{mark[0]}', but a file replaces only what has its own name",
        key=config_path,
        where=_place(file, mark),
        expected=f"'# @replaces {config_path}'",
    )


def _place(file: Path, mark: tuple[str, int] | None) -> str:
    return show_file(file, mark[1] if mark is not None else None)
