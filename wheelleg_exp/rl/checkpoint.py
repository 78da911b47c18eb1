"""Checkpoints: files with everything that training depends on, which load without running code from the file."""

from __future__ import annotations

import io
import sys
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from wheelleg_exp.asset.file_limits import bounded_memory
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.rl.policy_average import STATE
from wheelleg_exp.state import cloned
from wheelleg_exp.state.old_layout import from_format_2

if TYPE_CHECKING:
    from rsl_rl.algorithms import PPO, Distillation

FORMAT_VERSION = 3
# Checkpoints of version 1 contain the networks, but not all state that is needed to resume a training. In version 2,
# the state of the environment has another layout.
_READABLE = (1, 2, FORMAT_VERSION)
_NEEDED = {"format_version": object, "iter": int}
# An rsl_rl algorithm has two networks: an actor and a critic, or a student and a teacher.
ROLES = ("actor", "critic", "student", "teacher")
# ``load`` rejects checkpoints with too many objects, too deep nesting, or too many tensor bytes per file byte.
_MOST_PARTS, _DEEPEST, _TIMES = 1_000_000, 100, 16


def serialize(state: Mapping[str, object]) -> bytes:
    """Encode a training's state as the bytes of a checkpoint file. Equal states give equal bytes."""
    buffer = io.BytesIO()
    torch.save(_rebuilt(dict(state)), buffer)
    return buffer.getvalue()


def load(path: Path, *, finite: bool = True) -> dict[str, Any]:
    """Read a checkpoint; raise RunDirectoryError if it is missing, damaged, foreign, or not finite (if ``finite``)."""
    if not path.is_file():
        message = "the checkpoint does not exist"
        raise RunDirectoryError(message, key=str(path), expected="a model_<iteration>.pt of a run")
    try:
        state = read_tensors(path)
    except Exception as error:  # A damaged checkpoint can raise any exception; torch runs no code from the file.
        message = "the file cannot be read as a checkpoint: it is damaged, or contains data of unknown types"
        raise RunDirectoryError(message, key=str(path), expected="a model_<iteration>.pt of a run") from error
    state = state if isinstance(state, dict) else {}
    networks = [f"{role}_state_dict" for role in (ROLES[2:] if "student_state_dict" in state else ROLES[:2])]
    needed = _NEEDED | dict.fromkeys([*networks, *({STATE} & state.keys())], Mapping)
    missing = [key for key, kind in needed.items() if key not in state or not isinstance(state[key], kind)]
    if missing:
        message = f"the file is not a checkpoint of this program: it lacks '{missing[0]}'"
        raise RunDirectoryError(message, key=str(path), expected="a model_<iteration>.pt of a run")
    if type(state["format_version"]) is not int or state["format_version"] not in _READABLE:
        message = f"the checkpoint has format version {state['format_version']}"
        raise RunDirectoryError(message, key=str(path), expected=f"version {FORMAT_VERSION}")
    if finite:
        _require_finite(state, path)
    return state


def read_tensors(path: Path) -> object:
    """Return what ``torch.save`` wrote, as tensors in plain containers, and run no code from the file.

    A damaged file raises any exception. Too many objects, too much nesting, or too large tensors raise ValueError.
    """
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        require_bounded(archive)
    with warnings.catch_warnings(), bounded_memory(path, _TIMES * size + (1 << 30)):
        warnings.simplefilter("ignore")  # torch warns about checkpoint files that torch.save did not write.
        state = torch.load(path, map_location="cpu", weights_only=True)
    waiting, parts, room = [(state, 0)], 0, _TIMES * size + (1 << 20)
    while waiting:
        value, depth = waiting.pop()
        parts += 1
        if isinstance(value, torch.Tensor):
            if value.layout is not torch.strided or value.device.type != "cpu":
                raise ValueError("the checkpoint contains a tensor that is sparse or not on the CPU")
            room -= value.numel() * value.element_size()
        elif isinstance(value, Mapping):
            waiting += [(item, depth + 1) for pair in value.items() for item in pair]
        elif isinstance(value, (list, tuple, set, frozenset)):
            waiting += [(item, depth + 1) for item in value]
        if parts > _MOST_PARTS or depth > _DEEPEST or room < 0:
            raise ValueError("the checkpoint contains too many objects or too large tensors")
    return state


def _require_finite(state: Mapping[str, object], path: Path) -> None:
    """Raise RunDirectoryError if a network parameter is NaN or inf, because the policy's actions would be NaN."""
    for key in (*(f"{role}_state_dict" for role in ROLES), STATE):
        network = state.get(key)
        for name, value in network.items() if isinstance(network, Mapping) else ():
            if isinstance(value, torch.Tensor) and (bad := int((~value.isfinite()).sum())):
                where = f"{key.removesuffix('_state_dict')}.{name}"
                message = f"{bad} of the {value.numel()} numbers of {where} are NaN or inf"
                expected = "a checkpoint with finite parameters, perhaps an earlier one of this run"
                raise RunDirectoryError(message, key=str(path), expected=expected)


def env_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of the environment in the present layout; an empty dictionary if there is none."""
    found: dict[str, Any] = state.get("env") or {}
    return from_format_2(found) if found and state["format_version"] == 2 else found


def require_resumable(state: Mapping[str, object]) -> None:
    """Raise RunDirectoryError if a checkpoint lacks state that is needed to resume its training."""
    if state["format_version"] not in _READABLE[1:]:
        message = "the checkpoint contains only networks: it can be played, but a training cannot be resumed from it"
        expected = f"a checkpoint of format version {FORMAT_VERSION}; or a new training with init_from=RUN"
        raise RunDirectoryError(message, expected=expected)


def _rebuilt(value: object) -> object:
    """Return a deep copy of nested containers without shared objects, so that equal states give equal pickled bytes."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone(memory_format=torch.contiguous_format)
    if isinstance(value, Mapping):
        return {_rebuilt(key): _rebuilt(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_rebuilt(item) for item in value)
    return sys.intern(value) if isinstance(value, str) else value


def roles_of(algorithm: object) -> tuple[str, ...]:
    """Return the roles of an algorithm's networks: actor and critic, or student and teacher."""
    return tuple(role for role in ROLES if hasattr(algorithm, role))


def policy_state(state: Mapping[str, object]) -> object:
    """Return the policy's parameters in a checkpoint: the average if there is one, else those of student or actor."""
    return state.get(STATE) or state.get("student_state_dict") or state["actor_state_dict"]


def unsaved_state(algorithm: PPO | Distillation) -> dict[str, object]:
    """Return state that rsl_rl does not save: hidden states, the state of RND, the progress of a distillation."""
    hidden = {role: cloned(getattr(algorithm, role).get_hidden_state()) for role in roles_of(algorithm)}
    state: dict[str, object] = {"learning_rate": float(algorithm.learning_rate), "hidden": hidden}
    if hasattr(algorithm, "student"):
        state["distillation"] = {"updates": algorithm.num_updates, "hidden": cloned(algorithm.last_hidden_states)}
    if getattr(algorithm, "rnd", None) is not None:
        rnd = algorithm.rnd
        average = cloned(rnd.reward_normalizer.disc_avg.avg) if rnd.reward_normalization else None
        state["rnd"] = {"update_counter": rnd.update_counter, "average": average}
    return state


def load_unsaved_state(algorithm: PPO | Distillation, saved: Mapping[str, Any]) -> None:
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
