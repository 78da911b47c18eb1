"""Hydra's own settings in config files that nothing reads."""

from __future__ import annotations

from collections.abc import Sequence

from wheelleg_exp.config.checking.check_mounts import MountedFile
from wheelleg_exp.config.composing.hydra_keys import is_unread, unread
from wheelleg_exp.config.tree import defaults_entries, dotted, leaves, line_table, show_file, split_path
from wheelleg_exp.errors import ConfigError


def unread_in_files(files: Sequence[MountedFile], primary: str) -> list[ConfigError]:
    """Return the errors of settings and choices in files that nothing reads, not even in a sweep.

    The primary config is left out: there Hydra itself is kept from logging and from making folders.
    """
    errors = []
    for mounted in files:
        if mounted.config_path == primary:
            continue
        lines = line_table(mounted.file)
        package = split_path(mounted.package) if mounted.package else ()
        found = [(dotted((*package, *keys)), lines.get(keys)) for keys, _ in leaves(mounted.content)]
        found += [(entry.key.lstrip("/"), entry.line) for entry in defaults_entries(mounted.file)]
        errors += [unread(key, show_file(mounted.file, line)) for key, line in found if is_unread(key)]
    return errors
