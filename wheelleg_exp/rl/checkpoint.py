"""Checkpoints: everything that training depends on, in one file that loads without running anybody's code."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.errors import RunDirectoryError

FORMAT_VERSION = 2
_READABLE = (1, FORMAT_VERSION)  # version 1 lacks what a resume needs, but holds the same networks
_NEEDED = ("format_version", "iter", "actor_state_dict", "critic_state_dict")


def serialize(state: Mapping[str, Any]) -> bytes:
    """Return a checkpoint's bytes: the same state gives the same bytes, whatever objects hold it."""
    buffer = io.BytesIO()
    torch.save(_rebuilt(dict(state)), buffer)
    return buffer.getvalue()


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        RunDirectoryError: the file is missing, damaged, or no checkpoint of this program.
    """
    try:
        with warnings.catch_warnings():  # torch has advice for other kinds of files
            warnings.simplefilter("ignore")
            state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise RunDirectoryError("there is no such checkpoint", key=str(path)) from error
    except Exception as error:  # a damaged archive may fail in any way; nothing in it is run
        raise RunDirectoryError(
            "cannot be read as a checkpoint: it is damaged, or holds something else than numbers and names",
            key=str(path),
            expected="a model_<iteration>.pt of a run",
        ) from error
    missing = [key for key in _NEEDED if not isinstance(state, dict) or key not in state]
    if missing:
        raise RunDirectoryError(
            f"is no checkpoint of this program: it has no '{missing[0]}'",
            key=str(path),
            expected="a model_<iteration>.pt of a run",
        )
    if state["format_version"] not in _READABLE:
        raise RunDirectoryError(
            f"has format version {state['format_version']}",
            key=str(path),
            expected=f"version {FORMAT_VERSION}",
        )
    return state


def require_resumable(state: Mapping[str, Any]) -> None:
    """Raise RunDirectoryError when a checkpoint's networks can be used, but its training cannot go on."""
    if state["format_version"] != FORMAT_VERSION:
        raise RunDirectoryError(
            f"the checkpoint has format version {state['format_version']}: it can be played, not resumed",
            expected=f"version {FORMAT_VERSION}, which holds all that a training depends on",
        )


def _rebuilt(value: Any) -> Any:
    """Rebuild a tree so that no two parts share an object: pickle would write shared ones differently."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(value, Mapping):
        return {_rebuilt(key): _rebuilt(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_rebuilt(item) for item in value)
    if isinstance(value, str):
        return sys.intern(value)
    return value
