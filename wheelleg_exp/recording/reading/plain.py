"""Arrow's values as Python's own, whatever they are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pyarrow as pa

LONGEST = 4096  # letters of a word, or of what is told in words, that are read
MOST = 1 << 21  # values that are made into Python's own at a time


def plain(array: pa.Array | pa.ChunkedArray) -> list[Any]:
    """Return values as Python's, None for what Python has nothing for and for what are too many.

    Times of every kind are whole numbers of their unit, which is nanoseconds in rerun's files: Python's own times have
    microseconds and a smaller range, and Arrow asks for pandas where these do not do.
    """
    nothing = [None] * len(array)
    if any(pa.types.is_union(kind) or pa.types.is_map(kind) for kind in kinds_in(array.type)):
        return nothing
    if values_in(array) > MOST:
        return nothing
    try:
        return array.cast(_countable(array.type)).to_pylist()
    except ValueError:  # two fields of one name
        return nothing


def as_number(value: Any) -> float | None:
    """Return a value as a number, None when it is none."""
    return float(value) if isinstance(value, int | float) else None


def values_in(array: pa.Array | pa.ChunkedArray) -> int:
    """Return how many values there are on all levels of lists and structures."""
    if isinstance(array, pa.ChunkedArray):
        return sum(map(values_in, array.chunks))
    kind = array.type
    if is_list(kind):
        return len(array) + values_in(array.flatten())
    if pa.types.is_struct(kind):
        return len(array) + sum(map(values_in, array.flatten()))
    return len(array)


def kinds_in(kind: pa.DataType) -> Iterator[pa.DataType]:
    """Yield a type and all within it."""
    yield kind
    for i in range(kind.num_fields):
        yield from kinds_in(kind.field(i).type)


def is_list(kind: pa.DataType) -> bool:
    """Return whether a type's values are lists."""
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _countable(kind: pa.DataType) -> pa.DataType:
    """Return a type with whole numbers in place of times."""
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(_countable(kind.value_type), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(_countable(kind.value_type))
    if pa.types.is_large_list(kind):
        return pa.large_list(_countable(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, _countable(field.type)) for field in kind])
    if pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        return pa.int32() if kind.bit_width == 32 else pa.int64()
    return kind
