"""Read and write config keys and overrides as text.

A key is ``env.rewards.alive`` or ``env.robot.init_state.joint_pos[.*_hip]``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

Keys = tuple[str, ...]

_PART = re.compile(r"\[([^\]]*)\]|([^.\[\]]+)")


def is_override(word: str) -> bool:
    """Return whether a word of a command line is an override; any other word is a name."""
    return "=" in word or word.startswith(("~", "+"))


def dotted(keys: Iterable[str]) -> str:
    """Return the path as text. A key that contains dots or brackets is put in brackets."""
    text = ""
    for key in keys:
        text = below(text, key)
    return text


def below(path: str, key: str) -> str:
    """Return the path of the key ``key`` in the section at ``path``."""
    if re.search(r"[.\[\]]", key):
        return f"{path}[{key}]"
    return f"{path}.{key}" if path else key


def split_path(path: str) -> Keys:
    """Return the keys of a path such as ``env.rewards.alive`` or ``env.robot.joint_pos[.*_hip]``."""
    return tuple(bracket or plain for bracket, plain in _PART.findall(path))


PIPELINE = "pipeline"  # the name of the primary config for pipelines, and of its section


def names_pipeline(word: str) -> bool:
    """Return whether an override or a key selects or changes a pipeline. Others change what its phases train."""
    return word.lstrip("+~").partition("=")[0].split(".")[0] == PIPELINE
