"""Short digests of a training's state: each iteration logs them, and a checkpoint must agree with them.

Digests depend on names, types, shapes, and bytes only: they are equal if and only if states are equal bit for bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from wheelleg_exp.rl.policy_average import STATE
from wheelleg_exp.state.values import bytes_of

# ``FORMAT`` is the version of the hashes of checkpoints; see ``iteration_log.comparable_digests``.
FORMAT = 2

# Two different checkpoints have equal hashes of 16 hexadecimal digits with a probability of 5e-20.
_LENGTH = 16
_LABELS = ("format_version", "iter", "infos", "ranks")


def of_state(state: Mapping[str, Any]) -> dict[str, str]:
    """Return one digest (hash) for each part of a checkpoint, by the name of the part.

    ``parameters``: the networks. ``optimizer``: its state with the learning rate. ``environment``: without random
    streams. ``streams``: the random streams and torch's generators. ``log``: the running episode sums. ``mean``: the
    averaged weights, if any. ``rest``: all remaining parts. Each digest covers the state of all processes (ranks).
    """
    first = {name: tree_digest(part) for name, part in _parts(state).items()}
    return joined(first, [of_state(other) for other in state.get("ranks") or ()])


def format_of(state: Mapping[str, object]) -> int:
    """Return the digest format of a checkpoint, which depends on the layout of the environment's state."""
    return 1 if state["format_version"] in (1, 2) else FORMAT


def networks(state: Mapping[str, object]) -> dict[str, object]:
    """Return the networks in a checkpoint; the digest (hash) named ``parameters`` is computed from them."""
    return {key: value for key, value in state.items() if _part_of(key) == "parameters"}


def joined(first: Mapping[str, str], others: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Merge each digest (hash) of the first process (rank) with the same digest of all other ranks."""
    if not others:
        return dict(first)
    merged = {name: [first[name], *(one[name] for one in others)] for name in first.keys() & others[0].keys()}
    return {name: tree_digest(merged[name]) if name in merged else digest for name, digest in first.items()}


def tree_digest(tree: object) -> str:
    """Return a hash (16 hexadecimal digits) of the structure, types, and values of nested mappings and sequences."""
    digest = hashlib.sha256()
    _update(digest, "", tree)
    return digest.hexdigest()[:_LENGTH]


def _parts(state: Mapping[str, object]) -> dict[str, dict[str, object]]:
    parts: dict[str, dict[str, object]] = {}
    for key, value in state.items():
        if key == "env" and isinstance(value, Mapping):
            for name, item in value.items():
                parts.setdefault("streams" if name == "streams" else "environment", {})[f"env.{name}"] = item
        elif key not in _LABELS:
            parts.setdefault(_part_of(key), {})[key] = value
    return parts


def _part_of(key: str) -> str:
    known = {"env": "environment", "streams": "streams", "rng": "streams", "log": "log"}
    if key in known or key == STATE:
        return known.get(key, "mean")
    kind = "optimizer" if "optimizer" in key else "parameters"
    return kind if key.endswith("_state_dict") else "rest"


def _update(digest: hashlib._Hash, path: str, value: object) -> None:
    if isinstance(value, Mapping):
        digest.update(f"{path}\0{{{len(value)}\0".encode())
        for key, item in value.items():
            _update(digest, f"{type(key).__name__} {key}", item)
    elif isinstance(value, (list, tuple)):
        digest.update(f"{path}\0[{len(value)}\0".encode())
        for item in value:
            _update(digest, "", item)
    elif isinstance(value, torch.Tensor):
        digest.update(f"{path}\0{value.dtype} {tuple(value.shape)}\0".encode())
        digest.update(tensor_bytes(value))
    else:
        digest.update(f"{path}\0{type(value).__name__} {value!r}\0".encode())


def tensor_bytes(tensor: torch.Tensor) -> memoryview:
    """Return the bytes of a tensor's elements in order, without a copy if the tensor is contiguous."""
    return bytes_of(tensor.cpu()).numpy().data
