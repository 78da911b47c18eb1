"""Checkpoints: everything that training depends on, in one file that loads without running code from the file."""

from __future__ import annotations

import io
import sys
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.rl.policy_average import STATE
from wheelleg_exp.state import cloned

FORMAT_VERSION = 2
_READABLE = (1, FORMAT_VERSION)  # version 1 has the same networks, but lacks state that a resume needs
_NEEDED = {"format_version": object, "iter": int}
ROLES = ("actor", "critic", "student", "teacher")  # of networks; an algorithm has two of them
# Limits for a loaded tree: number of parts, depth of nesting, and size of the tensors relative to the file.
_MOST_PARTS, _DEEPEST, _TIMES = 1_000_000, 100, 16


def serialize(state: Mapping[str, Any]) -> bytes:
    """Return the bytes of a checkpoint. Equal states give equal bytes."""
    buffer = io.BytesIO()
    torch.save(_rebuilt(dict(state)), buffer)
    return buffer.getvalue()


def load(path: Path, *, finite: bool = True) -> dict[str, Any]:
    """Read a checkpoint.

    Args:
        path: the file.
        finite: whether to refuse networks whose parameters are NaN or inf.

    Raises:
        RunDirectoryError: the file is missing, damaged, or not a checkpoint of this program; or a parameter is not
            finite.
    """
    if not path.is_file():
        raise RunDirectoryError(
            "the checkpoint does not exist", key=str(path), expected="a model_<iteration>.pt of a run"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            require_bounded(archive)
        with warnings.catch_warnings():  # torch warns about other kinds of files
            warnings.simplefilter("ignore")
            state = torch.load(path, map_location="cpu", weights_only=True)
        _require_bounded(state, path.stat().st_size)
    except Exception as error:  # a damaged archive can raise any error; no code in it runs
        raise RunDirectoryError(
            "cannot be read as a checkpoint: it is damaged, or holds something else than numbers and names",
            key=str(path),
            expected="a model_<iteration>.pt of a run",
        ) from error
    state = state if isinstance(state, dict) else {}
    networks = [f"{role}_state_dict" for role in (ROLES[2:] if "student_state_dict" in state else ROLES[:2])]
    needed = _NEEDED | dict.fromkeys([*networks, *({STATE} & state.keys())], Mapping)
    missing = [key for key, kind in needed.items() if key not in state or not isinstance(state[key], kind)]
    if missing:
        raise RunDirectoryError(
            f"is not a checkpoint of this program: it lacks '{missing[0]}'",
            key=str(path),
            expected="a model_<iteration>.pt of a run",
        )
    if type(state["format_version"]) is not int or state["format_version"] not in _READABLE:
        raise RunDirectoryError(
            f"has format version {state['format_version']}",
            key=str(path),
            expected=f"version {FORMAT_VERSION}",
        )
    if finite:
        _require_finite(state, path)
    return state


def _require_finite(state: Mapping[str, Any], path: Path) -> None:
    """Raise RunDirectoryError, with the parameter, if a network has NaN or inf: its actions would be NaN too."""
    for key in (*(f"{role}_state_dict" for role in ROLES), STATE):
        network = state.get(key)
        for name, value in network.items() if isinstance(network, Mapping) else ():
            if isinstance(value, torch.Tensor) and (bad := int((~value.isfinite()).sum())):
                where = f"{key.removesuffix('_state_dict')}.{name}"
                raise RunDirectoryError(
                    f"{bad} of the {value.numel()} numbers of {where} are NaN or inf",
                    key=str(path),
                    expected="a checkpoint with finite parameters, perhaps an earlier one of this run",
                )


def require_resumable(state: Mapping[str, Any]) -> None:
    """Raise RunDirectoryError if a checkpoint's networks can be played, but its training cannot be resumed."""
    if state["format_version"] != FORMAT_VERSION:
        raise RunDirectoryError(
            f"the checkpoint has format version {state['format_version']}: it can be played, not resumed",
            expected=f"version {FORMAT_VERSION}, which holds all that a training depends on",
        )


def _require_bounded(state: Any, size: int) -> None:
    """Raise ValueError for a tree that is too large or too deep, or tensors that are larger than the file."""
    waiting, parts, room = [(state, 0)], 0, _TIMES * size + (1 << 20)
    while waiting:
        value, depth = waiting.pop()
        parts += 1
        if isinstance(value, torch.Tensor):
            if value.layout is not torch.strided or value.device.type != "cpu":
                raise ValueError("a tensor without its numbers")
            room -= value.numel() * value.element_size()
        elif isinstance(value, Mapping):
            waiting += [(item, depth + 1) for pair in value.items() for item in pair]
        elif isinstance(value, (list, tuple, set, frozenset)):
            waiting += [(item, depth + 1) for item in value]
        if parts > _MOST_PARTS or depth > _DEEPEST or room < 0:
            raise ValueError("it is larger than its file")


def _rebuilt(value: Any) -> Any:
    """Rebuild a tree so that no two parts share an object, because pickle writes shared objects differently."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(value, Mapping):
        return {_rebuilt(key): _rebuilt(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_rebuilt(item) for item in value)
    if isinstance(value, str):
        return sys.intern(value)
    return value


def roles_of(algorithm: Any) -> tuple[str, ...]:
    """Return the roles of an algorithm's networks: actor and critic, or student and teacher."""
    return tuple(role for role in ROLES if hasattr(algorithm, role))


def policy_state(state: Mapping[str, Any]) -> Any:
    """Return the policy's parameters in a checkpoint: the average if there is one, else those of student or actor."""
    return state.get(STATE) or state.get("student_state_dict") or state["actor_state_dict"]


def unsaved_state(algorithm: Any) -> dict[str, Any]:
    """Return hidden states of recurrent networks, the state of RND, and the progress of a distillation."""
    state: dict[str, Any] = {
        "learning_rate": float(algorithm.learning_rate),
        "hidden": {role: cloned(getattr(algorithm, role).get_hidden_state()) for role in roles_of(algorithm)},
    }
    if hasattr(algorithm, "student"):
        state["distillation"] = {"updates": algorithm.num_updates, "hidden": cloned(algorithm.last_hidden_states)}
    if getattr(algorithm, "rnd", None) is not None:
        state["rnd"] = {"update_counter": algorithm.rnd.update_counter, "average": _average(algorithm.rnd)}
    return state


def load_unsaved_state(algorithm: Any, saved: dict[str, Any]) -> None:
    """Restore what ``unsaved_state`` returned."""
    algorithm.learning_rate = saved["learning_rate"]
    for role, hidden in saved["hidden"].items():
        network = getattr(algorithm, role)
        if network.is_recurrent:
            network.reset()
            network.reset(hidden_state=cloned(hidden))
    if hasattr(algorithm, "student"):
        algorithm.num_updates = saved["distillation"]["updates"]
        algorithm.last_hidden_states = tuple(cloned(saved["distillation"]["hidden"]))
    if getattr(algorithm, "rnd", None) is not None:
        algorithm.rnd.update_counter = saved["rnd"]["update_counter"]
        if algorithm.rnd.reward_normalization:
            algorithm.rnd.reward_normalizer.disc_avg.avg = cloned(saved["rnd"]["average"])


def _average(rnd: Any) -> torch.Tensor | None:
    return cloned(rnd.reward_normalizer.disc_avg.avg) if rnd.reward_normalization else None
