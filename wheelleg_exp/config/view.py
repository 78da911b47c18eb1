"""What completion needs of a composed config, kept in a file, because a TAB must not wait for composing.

A kept view is used while no config file, and nothing else that went into it, has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import wheelleg_exp
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.paths import cache_dir, configs_dir

_KEPT = 32  # views before the oldest are dropped


@dataclass(frozen=True)
class View:
    """A composed config, as far as completion is concerned.

    Attributes:
        tree: the raw tree.
        mounts: the groups by the names that overrides use, each with whether it takes a list.
        groups: every group with its options.
    """

    tree: dict[str, Any]
    mounts: dict[str, bool]
    groups: dict[str, list[str]]


def view(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> View | None:
    """Return the view of what some overrides compose; of fewer of them where they do not; None when nothing does."""
    file = cache_dir() / "completion" / f"{_digest(before, config_dirs, primary)}.json"
    with contextlib.suppress(OSError, ValueError, TypeError):
        return View(**json.loads(file.read_text(encoding="utf-8")))
    made = _make(before, config_dirs, primary)
    if made is not None:
        with contextlib.suppress(OSError, TypeError):
            _keep(file, json.dumps(asdict(made)))
    return made


def _digest(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> str:
    """Return what a view depends on: the words, and names, sizes and times of all config files."""
    folders = [configs_dir(), *(folder.absolute() for folder in config_dirs)]
    files = [
        (str(path), (s := path.stat()).st_mtime_ns, s.st_size) for f in folders for path in sorted(f.rglob("*.yaml"))
    ]
    parts = [wheelleg_exp.__version__, list(before), [str(f) for f in folders], primary, files]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def _make(before: Sequence[str], config_dirs: Sequence[Path], primary: str) -> View | None:
    from wheelleg_exp.config.compose import compose

    for words in (list(before), [word for word in before if word.startswith("task=")], []):
        try:
            composed = compose(words, primary=primary, config_dirs=config_dirs)
        except WheellegError:
            continue
        groups = {group: composed.loader.options(group) for group in composed.loader.groups()}
        return View(composed.raw_tree(), {mount.name: mount.several for mount in composed.mounts}, groups)
    return None


def _keep(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(file)
    kept = sorted(file.parent.glob("*.json"), key=lambda path: path.stat().st_mtime)
    for old in kept[:-_KEPT]:
        old.unlink(missing_ok=True)
