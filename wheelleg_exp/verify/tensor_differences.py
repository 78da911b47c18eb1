"""Compare nested mappings of tensors, numbers, and text bit by bit. Import this module lazily: it imports torch."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch

from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.digests import tensor_bytes

_ABSENT = "(absent)"


@dataclass(frozen=True)
class Difference:
    """One tensor, number, or text that differs between two nested mappings A and B, and its dotted name."""

    name: str
    kind: str  # The kind of difference: ``values``, ``shape``, ``dtype``, ``kind``, ``only in A``, or ``only in B``.
    a: object  # ``a`` and ``b`` are the differing values, shapes, dtypes, or types in the mappings A and B.
    b: object
    index: tuple[int, ...] = ()  # The index of the tensor element with the largest difference.
    largest: float | None = None  # The largest absolute difference of two tensors, which can be NaN or inf.
    relative: float | None = None  # ``relative`` is ``largest`` divided by the larger of ``|a|`` and ``|b|``.
    count: int = 1  # The number of tensor elements that differ; ``of`` is the number of all elements.
    of: int = 1


def tree_differences(a: object, b: object, name: str = "") -> Iterator[Difference]:
    """Yield the tensors, numbers, and texts that differ between two nested mappings, in the order of their keys."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in dict.fromkeys([*a, *b]):
            yield from _child(a, b, key, f"{name}.{key}" if name else str(key))
    elif isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        for index in range(max(len(a), len(b))):
            yield from _child(dict(enumerate(a)), dict(enumerate(b)), index, f"{name}[{index}]")
    elif isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        if a.shape != b.shape:
            yield Difference(name, "shape", list(a.shape), list(b.shape))
        elif a.dtype != b.dtype:
            yield Difference(name, "dtype", str(a.dtype), str(b.dtype))
        elif tensor_bytes(a) != tensor_bytes(b):
            yield _values(name, a, b)
    elif type(a) is not type(b):
        yield Difference(name, "kind", type(a).__name__, type(b).__name__)
    elif isinstance(a, (int, float)) and isinstance(b, (int, float)) and not isinstance(a, bool):
        if struct.pack("d", a) != struct.pack("d", b) if isinstance(a, float) else a != b:
            largest, scale = float(abs(a - b)), max(abs(a), abs(b))
            yield Difference(name, "values", a, b, (), largest, float(largest / scale) if scale else 0.0)
    elif a != b:
        yield Difference(name, "values", a, b)


def count_leaves(tree: object) -> int:
    """Return the number of tensors, numbers, and texts in a nested mapping or list."""
    if isinstance(tree, Mapping):
        return sum(map(count_leaves, tree.values()))
    return sum(map(count_leaves, tree)) if isinstance(tree, (list, tuple)) else 1


def network_tensors(state: Mapping[str, object]) -> dict[str, torch.Tensor]:
    """Return the tensors of all networks in a checkpoint by name, such as ``actor.mlp.0.weight``."""
    return {
        f"{role}.{name}": value
        for role in checkpoint.ROLES
        if isinstance(network := state.get(f"{role}_state_dict"), Mapping)
        for name, value in network.items()
        if isinstance(value, torch.Tensor)
    }


def relative_distance(a: Mapping[str, torch.Tensor], b: Mapping[str, torch.Tensor]) -> float:
    """Return the relative Euclidean distance ``|a - b| / |b|`` of two mappings of tensors; inf if shapes differ."""
    if a.keys() != b.keys() or any(a[name].shape != b[name].shape for name in a):
        return math.inf
    apart = sum(float((a[name].double() - b[name].double()).square().sum()) for name in a)
    size = sum(float(b[name].double().square().sum()) for name in b)
    return math.sqrt(apart / size) if size else (math.inf if apart else 0.0)


def _child(a: Mapping[object, object], b: Mapping[object, object], key: object, name: str) -> Iterator[Difference]:
    if key not in b:
        yield Difference(name, "only in A", _brief(a[key]), _ABSENT)
    elif key not in a:
        yield Difference(name, "only in B", _ABSENT, _brief(b[key]))
    else:
        yield from tree_differences(a[key], b[key], name)


def _brief(value: object) -> str:
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, torch.Tensor) else type(value).__name__


def _values(name: str, a: torch.Tensor, b: torch.Tensor) -> Difference:
    width = a.element_size()
    # Compare bits instead of float values, because NaN != NaN and -0.0 == 0.0.
    bits = [torch.frombuffer(bytearray(tensor_bytes(x)), dtype=torch.uint8).reshape(-1, width) for x in (a, b)]
    differs = (bits[0] != bits[1]).any(dim=1)
    ones, others = (x.detach().cpu().contiguous().reshape(-1).double() for x in (a, b))
    apart = (ones - others).abs()
    # The difference of two inf or two NaN values would be NaN, so set the difference to 0.
    apart[(ones == others) | (ones.isnan() & others.isnan())] = 0.0
    odd = differs & ~apart.isfinite()
    if bool(odd.any()):
        at = int(odd.int().argmax())
    else:  # Elements such as 0.0 and -0.0 differ only in their bits, not in their values.
        at = int(apart.argmax()) if bool(apart.any()) else int(differs.int().argmax())
    largest, one, other = float(apart[at]), float(ones[at]), float(others[at])
    scale = max(abs(one), abs(other))
    relative = largest / scale if scale and math.isfinite(scale) else (0.0 if largest == 0.0 else math.nan)
    index = tuple(int(i) for i in torch.unravel_index(torch.tensor(at), a.shape)) if a.ndim else ()
    return Difference(name, "values", one, other, index, largest, relative, int(differs.sum()), a.numel())
