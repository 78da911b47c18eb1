"""``params/env.yaml`` and ``params/agent.yaml``: they build the same environment and agent again."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.files import read_yaml, write_text
from wheelleg_exp.run.plain_yaml import dump_yaml

PARTS = ("env", "agent")


def write_params(directory: Path, params: Mapping[str, dict[str, Any]]) -> None:
    """Write both files below ``directory/params``.

    Raises:
        RunDirectoryError: a part is missing or holds something that is not plain (nothing is written then).
    """
    if set(params) != set(PARTS):
        raise RunDirectoryError(f"parameters for {sorted(params)}", expected=" and ".join(PARTS))
    texts = {part: dump_yaml(params[part]) for part in PARTS}
    for part, text in texts.items():
        write_text(directory / "params" / f"{part}.yaml", text)


def load_params(directory: os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the environment's and the agent's parameters of a run directory.

    Raises:
        RunDirectoryError: a file is missing or is not the YAML of a mapping, with file and line.
    """
    env, agent = (_load(Path(directory) / "params" / f"{part}.yaml") for part in PARTS)
    return env, agent


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RunDirectoryError(f"there is no '{path}'", expected="the parameters that the run was made with")
    value = read_yaml(path)
    if not isinstance(value, dict):
        raise RunDirectoryError(f"a {type(value).__name__}, not parameters", where=str(path), expected="a mapping")
    return value
