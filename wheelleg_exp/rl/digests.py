"""Short digests of a training's state: what an iteration leaves in the log, and what a checkpoint must agree with.

They are computed from the tree that a checkpoint holds, so that they can be computed again from the file. Names,
kinds, shapes and bytes count, and nothing else: two states have equal digests when they are equal to the bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from wheelleg_exp.rl.policy_average import STATE
from wheelleg_exp.state.saved_values import bytes_of

if TYPE_CHECKING:
    from hashlib import _Hash

# Which definition of the digests a log holds; those of different formats cannot be compared.
FORMAT = 1

_LENGTH = 16  # hexadecimal digits: an unnoticed difference has a chance of 5e-20
_LABELS = ("format_version", "iter", "infos", "ranks")


def of_state(state: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of a checkpoint's tree by part.

    ``parameters`` are the networks, ``optimizer`` its state with the learning rate, ``environment`` all of the
    environment but its random streams, ``streams`` those and torch's, ``log`` the running episode sums, ``mean`` that
    of the policy's weights, where they are averaged, and ``rest`` whatever else there is. Of a training by several
    processes they are over the parts of all.
    """
    first = {name: tree_digest(part) for name, part in _parts(state).items()}
    return joined(first, [of_state(other) for other in state.get("ranks") or ()])


def networks(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return of a checkpoint's tree what ``parameters`` is the digest of."""
    return {key: value for key, value in state.items() if _part_of(key) == "parameters"}


def joined(first: Mapping[str, str], others: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Return the digests of the first process's parts with those of the others' parts of the same names."""
    if not others:
        return dict(first)
    return {
        name: tree_digest([digest, *(one[name] for one in others)]) if name in others[0] else digest
        for name, digest in first.items()
    }


def tree_digest(tree: Any) -> str:
    """Return 16 hexadecimal digits over a tree of mappings, sequences, tensors, numbers and text."""
    digest = hashlib.sha256()
    _update(digest, "", tree)
    return digest.hexdigest()[:_LENGTH]


def _parts(state: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    parts: dict[str, dict[str, Any]] = {}
    for key, path, value in _flattened(state):
        parts.setdefault(_part_of(key), {})[path] = value
    return parts


def _flattened(state: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    for key, value in state.items():
        if key == "env" and isinstance(value, Mapping):
            yield from (("streams" if name == "streams" else "env", f"env.{name}", v) for name, v in value.items())
        elif key not in _LABELS:
            yield key, key, value


def _part_of(key: str) -> str:
    known = {"env": "environment", "streams": "streams", "rng": "streams", "log": "log"}
    if key in known:
        return known[key]
    if key == STATE:
        return "mean"
    if key.endswith("_state_dict"):
        return "optimizer" if "optimizer" in key else "parameters"
    return "rest"


def _update(digest: _Hash, path: str, value: Any) -> None:
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
    """Return the bytes of a tensor's elements in their order, without a copy where it lies so in memory."""
    return bytes_of(tensor.cpu()).numpy().data
