"""Convert Arrow values to Python values, and rerun's columns to the types that their names imply."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pyarrow as pa

from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP

LONGEST_TEXT = 4096  # letters of a name or of an event's text that are read
TIMELINES = (STEP, SIM_TIME, ITERATION)
_TIMELINE_TYPES = {STEP: pa.int64(), SIM_TIME: pa.duration("ns"), ITERATION: pa.int64()}


def _vectors(width: int, kind: Any) -> pa.DataType:
    return pa.list_(pa.list_(kind, width))


_COMPONENT_TYPES: dict[str, pa.DataType] = {
    "scalars": pa.list_(pa.float64()),
    **dict.fromkeys(("text", "level", "names", "keys", "terms"), pa.list_(pa.string())),
    **dict.fromkeys(("translation", "vectors", "origins", "half_sizes"), _vectors(3, pa.float32())),
    **dict.fromkeys(("centers", "translations", "vertex_positions", "vertex_normals"), _vectors(3, pa.float32())),
    **dict.fromkeys(("quaternion", "quaternions"), _vectors(4, pa.float32())),
    "triangle_indices": _vectors(3, pa.uint32()),
    **dict.fromkeys(("radii", "lengths"), pa.list_(pa.float32())),
    **dict.fromkeys(("colors", "albedo_factor"), pa.list_(pa.uint32())),
}


def python_values(array: pa.Array | pa.ChunkedArray) -> list[Any]:
    """Return values as Python values; None for values of a type that Python does not have.

    Times become whole numbers of their unit, which is nanoseconds in rerun's files. Python's own times have only
    microseconds, and Arrow requires pandas for nanoseconds.
    """
    if any(pa.types.is_union(kind) or pa.types.is_map(kind) for kind in _nested_types(array.type)):
        return [None] * len(array)
    try:
        return array.cast(_times_as_integers(array.type)).to_pylist()
    except ValueError:  # two fields of a structure have one name
        return [None] * len(array)


def as_number(value: Any) -> float | None:
    """Return a value as a float; None when it is not a number."""
    return float(value) if isinstance(value, int | float) else None


def is_list(kind: pa.DataType) -> bool:
    """Return whether the values of a type are lists."""
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def is_component(field: pa.Field) -> bool:
    """Return whether a column of a batch contains data."""
    return (field.metadata or {}).get(b"rerun:kind") == b"data"


def is_index(field: pa.Field) -> bool:
    """Return whether a column of a batch is a timeline."""
    return (field.metadata or {}).get(b"rerun:kind") == b"index"


def short_name(name: str) -> str:
    """Return a column's name without its archetype: ``Scalars:scalars`` becomes ``scalars``."""
    return name.rsplit(":", 1)[-1]


def known_columns(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return a batch's timelines and components, each of the type that its name implies.

    A column is left out when its type cannot be converted to that of its name, and when an earlier column has the same
    short name.
    """
    found: dict[str, tuple[pa.Field, pa.Array]] = {}
    fields = sorted(zip(batch.schema, batch.columns, strict=True), key=lambda column: not is_index(column[0]))
    for field, array in fields:
        if is_index(field) or (is_component(field) and short_name(field.name) not in found):
            is_time = is_index(field)
            values = _timeline_values(field.name, array) if is_time else _component_values(field.name, array)
            if values is not None:
                found[short_name(field.name)] = (field.with_type(values.type), values)
    arrays = [array for _, array in found.values()]
    schema = pa.schema([field for field, _ in found.values()], metadata=batch.schema.metadata)
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _timeline_values(name: str, array: pa.Array) -> pa.Array:
    return array.view(_TIMELINE_TYPES[name]) if name in _TIMELINE_TYPES else array


def _component_values(name: str, array: pa.Array) -> pa.Array | None:
    wanted = _COMPONENT_TYPES.get(short_name(name))
    if wanted is None or array.type == wanted:
        return array
    return array.cast(wanted, safe=False) if _is_convertible(array.type, wanted) else None


def _is_convertible(kind: pa.DataType, wanted: pa.DataType) -> bool:
    """Return whether two types differ in precision at most."""
    if pa.types.is_null(kind):
        return True
    if is_list(wanted):
        sizes = {k.list_size for k in (kind, wanted) if pa.types.is_fixed_size_list(k)}
        return is_list(kind) and len(sizes) < 2 and _is_convertible(kind.value_type, wanted.value_type)
    if pa.types.is_string(wanted):
        return pa.types.is_string(kind) or pa.types.is_large_string(kind)
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


def _nested_types(kind: pa.DataType) -> Iterator[pa.DataType]:
    """Yield a type and all types inside it."""
    yield kind
    for i in range(kind.num_fields):
        yield from _nested_types(kind.field(i).type)


def _times_as_integers(kind: pa.DataType) -> pa.DataType:
    """Return a type with whole numbers in place of times."""
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(_times_as_integers(kind.value_type), kind.list_size)
    if pa.types.is_list(kind):
        return pa.list_(_times_as_integers(kind.value_type))
    if pa.types.is_large_list(kind):
        return pa.large_list(_times_as_integers(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, _times_as_integers(field.type)) for field in kind])
    if pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        return pa.int32() if kind.bit_width == 32 else pa.int64()
    return kind
