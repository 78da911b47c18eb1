"""What rerun's components are made of, by their short names: others by such a name are left out, as if not there."""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP
from wheelleg_exp.recording.reading.plain import is_list

TIMELINES = (STEP, SIM_TIME, ITERATION)
_TIMES = {STEP: pa.int64(), SIM_TIME: pa.duration("ns"), ITERATION: pa.int64()}


def _vectors(width: int, kind: Any) -> pa.DataType:
    return pa.list_(pa.list_(kind, width))


_KINDS: dict[str, pa.DataType] = {
    "scalars": pa.list_(pa.float64()),
    **dict.fromkeys(("text", "level", "names", "keys", "terms"), pa.list_(pa.string())),
    **dict.fromkeys(("translation", "vectors", "origins", "half_sizes"), _vectors(3, pa.float32())),
    **dict.fromkeys(("centers", "translations", "vertex_positions", "vertex_normals"), _vectors(3, pa.float32())),
    **dict.fromkeys(("quaternion", "quaternions"), _vectors(4, pa.float32())),
    "triangle_indices": _vectors(3, pa.uint32()),
    **dict.fromkeys(("radii", "lengths"), pa.list_(pa.float32())),
    **dict.fromkeys(("colors", "albedo_factor"), pa.list_(pa.uint32())),
}


def is_component(field: pa.Field) -> bool:
    """Return whether a column of a batch holds data."""
    return (field.metadata or {}).get(b"rerun:kind") == b"data"


def is_index(field: pa.Field) -> bool:
    """Return whether a column of a batch is a timeline."""
    return (field.metadata or {}).get(b"rerun:kind") == b"index"


def short(name: str) -> str:
    """Return a column's name without its archetype: ``Scalars:scalars`` is ``scalars``."""
    return name.rsplit(":", 1)[-1]


def known(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return a batch's timelines and components, each of the kind that its name means.

    A column by a known name that is of another kind is left out, and so is the second of two by one short name.
    """
    found: dict[str, tuple[pa.Field, pa.Array]] = {}
    fields = sorted(zip(batch.schema, batch.columns, strict=True), key=lambda column: not is_index(column[0]))
    for field, array in fields:
        if is_index(field) or (is_component(field) and short(field.name) not in found):
            values = _time(field.name, array) if is_index(field) else _component(short(field.name), array)
            if values is not None:
                found[short(field.name)] = (field.with_type(values.type), values)
    arrays = [array for _, array in found.values()]
    schema = pa.schema([field for field, _ in found.values()], metadata=batch.schema.metadata)
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _time(name: str, array: pa.Array) -> pa.Array:
    return array.view(_TIMES[name]) if name in _TIMES else array


def _component(name: str, array: pa.Array) -> pa.Array | None:
    wanted = _KINDS.get(name)
    if wanted is None or array.type == wanted:
        return array
    return array.cast(wanted, safe=False) if _is_like(array.type, wanted) else None


def _is_like(kind: pa.DataType, wanted: pa.DataType) -> bool:
    """Return whether values of a kind are those of another, at another precision perhaps."""
    if pa.types.is_null(kind):
        return True
    if is_list(wanted):
        sizes = {k.list_size for k in (kind, wanted) if pa.types.is_fixed_size_list(k)}
        return is_list(kind) and len(sizes) < 2 and _is_like(kind.value_type, wanted.value_type)
    if pa.types.is_string(wanted):
        return pa.types.is_string(kind) or pa.types.is_large_string(kind)
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)
