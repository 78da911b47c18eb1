"""Convert Arrow values to Python values, and the columns of a recording to the Arrow types of Rerun's components."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa

from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP

LONGEST_TEXT = 4096  # Names and event texts in a recording are truncated to 4096 characters.
TIMELINES = (STEP, SIM_TIME, ITERATION)
_TIMELINE_TYPES = {STEP: pa.int64(), SIM_TIME: pa.duration("ns"), ITERATION: pa.int64()}


_VECTORS = pa.list_(pa.list_(pa.float32(), 3))
_COMPONENT_TYPES: dict[str, pa.DataType] = {
    "scalars": pa.list_(pa.float64()),
    **dict.fromkeys(("text", "level", "names", "keys", "terms"), pa.list_(pa.string())),
    **dict.fromkeys(("translation", "vectors", "origins", "half_sizes"), _VECTORS),
    **dict.fromkeys(("centers", "translations", "vertex_positions", "vertex_normals"), _VECTORS),
    **dict.fromkeys(("quaternion", "quaternions"), pa.list_(pa.list_(pa.float32(), 4))),
    "triangle_indices": pa.list_(pa.list_(pa.uint32(), 3)),
    **dict.fromkeys(("radii", "lengths"), pa.list_(pa.float32())),
    **dict.fromkeys(("colors", "albedo_factor"), pa.list_(pa.uint32())),
}


def python_values(array: pa.Array | pa.ChunkedArray) -> list[object]:
    """Convert Arrow values to Python values. Arrow values that Arrow cannot convert become None.

    Times become integers in the unit of the Arrow type, which is nanoseconds in Rerun's files. Python's time types have
    no nanoseconds, and Arrow's conversion of nanoseconds needs pandas.
    """
    if any(pa.types.is_union(kind) or pa.types.is_map(kind) for kind in _nested_types(array.type)):
        return [None] * len(array)
    try:
        return list(array.cast(_times_as_integers(array.type)).to_pylist())
    except ValueError:  # Arrow raises ValueError if two fields of an Arrow struct have equal names.
        return [None] * len(array)


def as_number(value: object) -> float | None:
    """Convert a value to a float; return None if the value is not a number."""
    return float(value) if isinstance(value, int | float) else None


def is_list(kind: pa.DataType) -> bool:
    """Return whether an Arrow type is a list type."""
    return any(test(kind) for test in (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list))


def is_component(field: pa.Field) -> bool:
    """Return whether a column of an Arrow record batch contains data (a Rerun component)."""
    return (field.metadata or {}).get(b"rerun:kind") == b"data"


def is_index(field: pa.Field) -> bool:
    """Return whether a column of an Arrow record batch contains times (a Rerun timeline)."""
    return (field.metadata or {}).get(b"rerun:kind") == b"index"


def short_name(name: str) -> str:
    """Return a column's name without its archetype: ``Scalars:scalars`` becomes ``scalars``."""
    return name.rsplit(":", 1)[-1]


def known_columns(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Convert columns to the Arrow types of Rerun's components; omit the columns that cannot be converted."""
    found: dict[str, tuple[pa.Field, pa.Array]] = {}
    fields = sorted(zip(batch.schema, batch.columns, strict=True), key=lambda column: not is_index(column[0]))
    for field, array in fields:
        name, values = short_name(field.name), None
        if is_index(field):
            values = array.view(_TIMELINE_TYPES[field.name]) if field.name in _TIMELINE_TYPES else array
        elif is_component(field) and name not in found:
            wanted = _COMPONENT_TYPES.get(name, array.type)
            if array.type == wanted:
                values = array
            elif _is_convertible(array.type, wanted):
                values = array.cast(wanted, safe=False)
        if values is not None:
            found[name] = (field.with_type(values.type), values)
    schema = pa.schema([field for field, _ in found.values()], metadata=batch.schema.metadata)
    return pa.RecordBatch.from_arrays([array for _, array in found.values()], schema=schema)


def _is_convertible(kind: pa.DataType, wanted: pa.DataType) -> bool:
    """Return whether two Arrow types are equal or differ only in the precision of their numbers."""
    if pa.types.is_null(kind):
        return True
    if is_list(wanted):
        sizes = {k.list_size for k in (kind, wanted) if pa.types.is_fixed_size_list(k)}
        return is_list(kind) and len(sizes) < 2 and _is_convertible(kind.value_type, wanted.value_type)
    if pa.types.is_string(wanted):
        return any(test(kind) for test in (pa.types.is_string, pa.types.is_large_string))
    return any(test(kind) for test in (pa.types.is_integer, pa.types.is_floating))


def _nested_types(kind: pa.DataType) -> Iterator[pa.DataType]:
    yield kind
    for i in range(kind.num_fields):
        yield from _nested_types(kind.field(i).type)


def _times_as_integers(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(_times_as_integers(kind.value_type), kind.list_size)
    if is_list(kind):
        return pa.list_(_times_as_integers(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(field.name, _times_as_integers(field.type)) for field in kind])
    if pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        return pa.int32() if kind.bit_width == 32 else pa.int64()
    return kind
