"""Convert config keys, such as ``env.rewards.alive`` or ``joint_pos[.*_hip]``, and overrides from and to text."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable

Keys = tuple[str, ...]

_PART = re.compile(r"\[([^\]]*)\]|([^.\[\]]+)")


def is_override(word: str) -> bool:
    """Return whether a command-line argument is a config override. All other arguments are names."""
    return "=" in word or word.startswith(("~", "+"))


def dotted(keys: Iterable[str]) -> str:
    """Join the keys of a config path with dots, but enclose each key that contains dots or brackets in brackets."""
    return functools.reduce(below, keys, "")


def below(path: str, key: str) -> str:
    """Append a key to a config path: ``env.sim`` and ``device`` give ``env.sim.device``."""
    if re.search(r"[.\[\]]", key):
        return f"{path}[{key}]"
    return f"{path}.{key}" if path else key


def split_path(path: str) -> Keys:
    """Return the keys of a path such as ``env.rewards.alive`` or ``env.robot.joint_pos[.*_hip]``."""
    return tuple(bracket or plain for bracket, plain in _PART.findall(path))


PIPELINE = "pipeline"  # Hydra's primary config ``pipeline`` has a section ``pipeline``.


def names_pipeline(word: str) -> bool:
    """Return whether a config override or config key belongs to the config section ``pipeline``."""
    return word.lstrip("+~").partition("=")[0].split(".")[0] == PIPELINE
