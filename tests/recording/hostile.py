"""Recordings that no honest writer makes: sizes, paths, references, names and numbers that do not add up."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

import numpy as np
import pyarrow as pa
from rrd import (
    ACTIVATION,
    END,
    HEADER,
    ITERATION,
    LZ4,
    PLAIN,
    ROWS,
    SIM_TIME,
    STEP,
    announced,
    batch,
    data,
    healthy,
    lists,
    message,
    number,
    numbers,
    packed,
    rows,
    static,
    steps,
    store,
    stream,
)

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202egnp.exe\u2066\r\x08\x00$\\frac{$</script>[/b]"
OUTSIDE = r"\/tmp\/outside"  # as a part of an entity path
VECTOR, POINT = pa.list_(pa.list_(pa.float32(), 3)), pa.list_(pa.float32(), 3)
LIMITS = [-(2**63), 2**63 - 1, 0, -1]


def whole(*messages: bytes) -> bytes:
    """Return a file that holds a pose, a height and some messages."""
    return HEADER + announced() + numbers("base/height", [0.1, 0.2, 0.3]) + b"".join(messages)


def many(count: int, values: pa.Array) -> pa.Array:
    """Return so many lists that share values evenly."""
    return pa.ListArray.from_arrays(pa.array(np.linspace(0, len(values), count + 1), pa.int32(), safe=False), values)


def floats(values: list[list[float] | None]) -> pa.Array:
    return pa.array(values, pa.list_(pa.float64()))


def vectors(*values: list[float]) -> pa.Array:
    """Return one row of vectors."""
    return pa.array([list(values)], pa.list_(pa.list_(pa.float32(), len(values[0]))))


def scalars(entity: str, values: pa.Array, times: Mapping[str, pa.Array] | None = None) -> bytes:
    return rows(entity, {"Scalars:scalars": values}, times)


def text(entity: str, content: str) -> bytes:
    return static(entity, **{"TextDocument:text": _strings(content)})


def patched(content: bytes, old: bytes, new: bytes) -> bytes:
    assert old in content
    return content.replace(old, new)


def _stream(**columns: pa.Array) -> bytes:
    return stream(batch("a", columns or {"Scalars:scalars": lists([1.0, 2.0, 3.0], pa.float64())}, steps(3)))


def _offsets(values: list[int]) -> bytes:
    return packed(patched(_stream(), struct.pack("<4i", 0, 1, 2, 3), struct.pack("<4i", *values)))


def _compressed(codec: str, claimed: int | None = None) -> bytes:
    """Return rows whose Arrow buffers are compressed by Arrow, which rerun's never are."""
    values = many(1, pa.array(np.zeros(1 << 22)))
    made, sink = batch("a", {"Scalars:scalars": values}, steps(1)), pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, made.schema, options=pa.ipc.IpcWriteOptions(compression=codec)) as writer:
        writer.write_batch(made)
    content = sink.getvalue().to_pybytes()
    if claimed is not None:
        content = patched(content, struct.pack("<q", 8 << 22), struct.pack("<q", claimed))
    return packed(content)


def _nested(depth: int) -> bytes:
    kind: pa.DataType = pa.float64()
    for _ in range(depth):
        kind = pa.list_(kind)
    return scalars("a", pa.nulls(1, kind))


def pose(entity: str, count: int = 3, times: Mapping[str, pa.Array] | None = None) -> bytes:
    columns = {
        "Transform3D:translation": pa.array([[[0.0, 0.0, 0.1]]] * count, VECTOR),
        "Transform3D:quaternion": pa.array([[[0.0, 0.0, 0.0, 1.0]]] * count, pa.list_(pa.list_(pa.float32(), 4))),
    }
    return rows(entity, columns, times)


BOX = static("world/body/box", **{"Boxes3D:half_sizes": vectors([0.1, 0.1, 0.1])})


def _box(**changes: pa.Array) -> bytes:
    shape = {"half_sizes": vectors([0.1, 0.1, 0.1]), **changes}
    columns = {f"Boxes3D:{name}": values for name, values in shape.items()}
    return whole(pose("world/body"), static("world/body/box", **columns))


def _mesh(vertices: list[list[float]], faces: list[list[int]]) -> bytes:
    return whole(
        pose("world/body"),
        static(
            "world/body/mesh",
            **{
                "Mesh3D:vertex_positions": pa.array([vertices], VECTOR),
                "Mesh3D:triangle_indices": pa.array([faces], pa.list_(pa.list_(pa.uint32(), 3))),
            },
        ),
    )


def _times(kind: pa.DataType, name: str, values: list[int | None]) -> bytes:
    times = {**steps(len(values)), name: pa.array(values, kind)}
    log = rows("log/episodes", {"TextLog:text": lists(["env 0: ended by x"] * len(values))}, times)
    return whole(numbers("terminations/fell", [0.0] * len(values), times), numbers("base/pitch", [1.0] * 4, times), log)


def _own(**values: pa.Array) -> bytes:
    return whole(static("__properties/wheelleg", **values), numbers("terminations/fell", [0.0, 1.0, 0.0]))


def _strings(*values: str | None) -> pa.Array:
    return pa.array([list(values)], pa.list_(pa.string()))


def _scalars(values: pa.Array) -> bytes:
    return whole(scalars("rewards/odd", values), numbers("rewards/total", [1.0, 2.0, 3.0]))


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(b)}: &{chr(b)} [{','.join(['*' + chr(b - 1)] * 9)}]\n" for b in range(98, 108)
)

HOSTILE: dict[str, Callable[[], bytes]] = {
    # messages
    "a length of 2^63": lambda: whole(message(ROWS, b"", length=2**63)),
    "a length of 2^64 - 1": lambda: whole(message(ROWS, b"", length=2**64 - 1)),
    "an unknown kind of message": lambda: whole(message(2**63, b"x")),
    "fields longer than their message": lambda: whole(message(ROWS, data(1, b"x", length=2**40))),
    "a number that never ends": lambda: whole(message(ROWS, b"\xff" * 4096)),
    "groups of protobuf": lambda: whole(message(ROWS, b"\x0b\x0c" * 64)),
    "rows without a store": lambda: whole(message(ROWS, number(2, LZ4) + data(5, b"x"))),
    "a store that is not announced": lambda: whole(packed(_stream(), of=store(name="other"))),
    "a store whose name is no text": lambda: whole(packed(_stream(), of=number(1, 1) + data(2, b"\xff\xfe"))),
    "an index in the middle": lambda: whole(message(END, b"\x01\x02"), numbers("late", [1.0])),
    "an index that claims another place": lambda: whole(
        message(END, b"x"), struct.pack("<QQI8sI", 2**63, 2**63, 1, b"RRF2FOOT", 1)
    ),
    "an activation of nothing": lambda: whole(message(ACTIVATION, b"\xff\xff"), message(ACTIVATION, b"")),
    "a layout from elsewhere": lambda: whole(
        announced(kind=2, name="bp"), packed(_stream(), of=store(2, "bp", ESCAPES))
    ),
    "two recordings": lambda: whole(announced(name=ESCAPES), packed(_stream(), of=store(name=ESCAPES))),
    "another program's name": lambda: (
        HEADER + announced(application=ESCAPES) + packed(_stream(), of=store(application=ESCAPES))
    ),
    "no rows": lambda: HEADER + announced() + scalars("base/height", floats([])),
    "thousands of tiny messages": lambda: whole(*[numbers(f"tiny/{i % 300}", [float(i)]) for i in range(600)]),
    "nothing but zeros": lambda: HEADER + bytes(100_000),
    # sizes
    "unpacked, 2^40 bytes": lambda: whole(packed(_stream(), size=2**40)),
    "unpacked, fewer bytes than are packed": lambda: whole(packed(_stream(), size=8)),
    "unpacked, a gigabyte of zeros": lambda: whole(packed(bytes(250 << 20), size=1 << 30)),
    "an unknown compression": lambda: whole(packed(_stream(), how=7)),
    "buffers that Arrow is to unpack": lambda: whole(_compressed("zstd")),
    "buffers that claim to unpack to 2^40 bytes": lambda: whole(_compressed("lz4", 2**40)),
    "numbers by the million in a row": lambda: _scalars(many(3, pa.array(np.zeros(6 << 20)))),
    "names by the million": lambda: whole(
        static("base/height", **{"SeriesLines:names": many(1, pa.array(np.full(3 << 20, "")))})
    ),
    "a property of millions of bytes": lambda: _own(blob=many(1, pa.array(np.zeros(8 << 20, np.uint8)))),
    "an image of millions of pixels": lambda: whole(
        rows("camera", {"Image:buffer": pa.array([[bytes(16 << 20)]], pa.list_(pa.large_binary()))}),
        static("asset", **{"Asset3D:blob": pa.array([[bytes(16 << 20)]], pa.list_(pa.binary()))}),
    ),
    # Arrow
    "offsets beyond the values": lambda: whole(_offsets([0, 1, 2, 2**31 - 1])),
    "offsets that fall": lambda: whole(_offsets([0, 3, 1, 3])),
    "negative offsets": lambda: whole(_offsets([-9, 1, 2, 3])),
    "columns of other lengths": lambda: whole(
        packed(patched(_stream(), struct.pack("<qq", 3, 0), struct.pack("<qq", 2**40, 0)))
    ),
    "a negative number of rows": lambda: whole(
        packed(patched(_stream(), struct.pack("<qq", 3, 0), struct.pack("<qq", -3, 0)))
    ),
    "lists in lists in lists": lambda: whole(_nested(60)),
    "no schema": lambda: whole(packed(b"\xff\xff\xff\xff\0\0\0\0")),
    "no Arrow at all": lambda: whole(packed(b"not arrow", how=PLAIN)),
    "an extension type that is a pickle": lambda: whole(packed(_pickled())),
    "texts that are no text": lambda: whole(
        packed(patched(_stream(**{"TextLog:text": lists(["abcdef"] * 3)}), b"abcdef", b"\xff\xfe\xfd\xff\xfe\xfd"))
    ),
    # paths and names
    "a path that leads outside": lambda: whole(
        numbers(f"{OUTSIDE}/b", [1.0]), numbers(r"..\/..\/outside/b", [1.0]), numbers("../../outside", [1.0])
    ),
    "a path of escapes": lambda: whole(
        numbers(f"base/{ESCAPES}", [1.0]), numbers(f"{ESCAPES}/x", [1.0]), rows(ESCAPES, {ESCAPES: lists(["x"])})
    ),
    "a path of thousands of parts": lambda: whole(numbers("/".join("a" * 20_000), [1.0])),
    "a path of a megabyte": lambda: whole(numbers("a" * (1 << 20), [1.0])),
    "a path that is no text": lambda: whole(
        packed(
            patched(
                stream(batch("/abcdef", {"Scalars:scalars": lists([1.0])}, steps(1))),
                b"/abcdef",
                b"\xff\xfe\xfd\xff\xfe\xfdx",
            )
        )
    ),
    "an empty path": lambda: whole(numbers("", [1.0]), numbers("///", [1.0])),
    "words of escapes": lambda: whole(
        rows(
            "log/events",
            {
                "TextLog:text": lists([ESCAPES, f"env 0: {ESCAPES}", "env 99999999999999999999: x"]),
                "TextLog:level": lists([ESCAPES] * 3),
            },
        ),
        rows("log/recording", {"TextLog:text": lists([ESCAPES] * 3)}),
        rows("log/episodes", {"TextLog:text": pa.array([None, [], [None]], pa.list_(pa.string()))}),
        text(f"documents/{ESCAPES}", ESCAPES),
        static("contacts/feet", **{"SeriesLines:names": _strings(ESCAPES, "../../x", None)}),
        scalars("contacts/feet", floats([[1.0, 2.0, 3.0]] * 3)),
    ),
    "names that are twice there": lambda: whole(
        rows("base/roll", {"Scalars:scalars": lists([1.0]), "Other:scalars": lists([2.0])}),
        rows("base/yaw", {"Scalars:scalars": lists([1.0]), "step": lists([2.0])}),
    ),
    # kinds of values
    "numbers that are words": lambda: _scalars(lists(["one", "two", "three"])),
    "numbers that are structures": lambda: _scalars(lists([{"a": 1.0}] * 3)),
    "numbers that are lists": lambda: _scalars(lists([[1.0], [2.0], []])),
    "numbers that are no lists": lambda: _scalars(pa.array([1.0, 2.0, 3.0])),
    "numbers that are nothing": lambda: _scalars(pa.nulls(3, pa.null())),
    "numbers that are missing": lambda: _scalars(floats([None, [], [None]])),
    "numbers of another width in each row": lambda: _scalars(floats([[1.0], [1.0, 2.0], []])),
    "numbers at the end of their range": lambda: _scalars(lists([2**64 - 1] * 3, pa.uint64())),
    "numbers that are not finite": lambda: _scalars(lists([float("nan"), float("inf"), 1.8e308])),
    "words that are numbers": lambda: whole(
        rows("log/events", {"TextLog:text": lists([1.0, 2.0])}),
        static("documents/config", **{"TextDocument:text": lists([1])}),
    ),
    # times
    "steps at the ends of their range": lambda: _times(pa.int64(), STEP, LIMITS),
    "times at the ends of their range": lambda: _times(pa.duration("ns"), SIM_TIME, LIMITS),
    "iterations at the ends of their range": lambda: _times(pa.int64(), ITERATION, LIMITS),
    "steps that are moments": lambda: _times(pa.timestamp("ns"), STEP, LIMITS),
    "times that are numbers": lambda: _times(pa.int64(), SIM_TIME, LIMITS),
    "times that are missing": lambda: _times(pa.int64(), STEP, [None, 1, None, 2]),
    "no times": lambda: whole(
        rows("base/roll", {"Scalars:scalars": lists([1.0])}, {"frame": pa.array([1], pa.int64())})
    ),
    # what a recording says of itself
    "environments that are words": lambda: _own(env_ids=_strings("x", ESCAPES)),
    "environments without end": lambda: _own(env_ids=pa.array([list(range(100_000))], pa.list_(pa.int64()))),
    "environments below zero": lambda: _own(env_ids=pa.array([[-1, -(2**63)]], pa.list_(pa.int64()))),
    "a step of no length": lambda: _own(step_dt=lists([0.0]), purpose=lists(["play"])),
    "a step that is not finite": lambda: _own(step_dt=lists([float("nan")]), purpose=lists(["play"])),
    "a step that is a word": lambda: _own(step_dt=_strings("x"), purpose=lists([b"\xff"])),
    "facts of escapes": lambda: _own(
        task=_strings(ESCAPES), agent=_strings(ESCAPES), purpose=_strings(ESCAPES), run_id=_strings(ESCAPES)
    ),
    "facts that are tables": lambda: _own(
        task=lists([{"a": 1}]), agent=lists([[1]]), purpose=lists([{"a": 1}]), env_ids=lists([{"a": 1}])
    ),
    "weights that are words": lambda: whole(
        numbers("rewards/a", [1.0]),
        static("rewards", terms=_strings("a"), weights=_strings("x")),
        static("joints/j", effort_limit=_strings("x")),
        numbers("joints/j/effort", [1.0]),
    ),
    "a journal of nonsense": lambda: whole(
        static("__journal/training", keys=_strings("../../x", ESCAPES, "a/b", None)),
        scalars(
            "__journal/training",
            floats([[1.0], None, [1.0, 2.0, 3.0, 4.0, 5.0]]),
            steps(3, iteration=pa.array([0, None, 2**63 - 1], pa.int64())),
        ),
    ),
    "a journal that is no text": lambda: whole(
        static("__journal/training", keys=lists([1])),
        scalars("__journal/training", lists(["x"]), steps(1, iteration=pa.array([0], pa.int64()))),
    ),
    "a config that unfolds without end": lambda: whole(text("documents/config", BOMB)),
    "a config that runs a program": lambda: whole(
        text("documents/config", "!!python/object/apply:os.system ['touch outside']")
    ),
    # shapes
    "a box without an end": lambda: _box(half_sizes=vectors([float("inf"), float("nan"), -1.0])),
    "a box that is a word": lambda: _box(half_sizes=_strings("x")),
    "a box of two numbers": lambda: _box(half_sizes=vectors([0.1, 0.1])),
    "a box turned by nothing": lambda: _box(quaternions=vectors([float("nan")] * 4)),
    "a box of no colour": lambda: _box(colors=_strings(ESCAPES)),
    "a capsule without a length": lambda: whole(
        pose("world/body"),
        static("world/body/c", **{"Capsules3D:radii": pa.array([[0.1, 0.2]], pa.list_(pa.float32()))}),
    ),
    "a mesh whose corners are not there": lambda: _mesh([[0.0, 0.0, 0.0]] * 3, [[0, 1, 2**32 - 1]]),
    "a mesh of nothing": lambda: _mesh([], []),
    "a mesh that is not finite": lambda: _mesh([[float("nan"), float("inf"), 0.0]] * 4, [[0, 1, 2], [1, 2, 3]]),
    "a pose of words": lambda: whole(
        pose("world/body"), rows("world/body", {"Transform3D:translation": lists(["x"] * 3)})
    ),
    "poses of some bodies alone": lambda: whole(
        pose("world/a", 3),
        pose("world/b", 1),
        static("world/a/box", **{"Boxes3D:half_sizes": vectors([0.1, 0.1, 0.1])}),
    ),
    "arrows that do not begin": lambda: whole(
        pose("world/body"),
        BOX,
        rows(
            "overlay/contacts/feet",
            {
                "Arrows3D:vectors": pa.array([[[1.0, 2.0, 3.0]] * 2, None, []], VECTOR),
                "Arrows3D:origins": pa.array([[], None, [[1.0, 2.0, 3.0]] * 5], VECTOR),
            },
        ),
    ),
    "a healthy one with a second end": lambda: healthy() + healthy()[12:],
}


def _pickled() -> bytes:
    """Return rows of a type whose old form was a pickle that Arrow ran."""
    fields = {
        b"ARROW:extension:name": b"arrow.py_extension_type",
        b"ARROW:extension:metadata": b"cos\nsystem\n(S'touch outside'\ntR.",
    }
    made = batch("a", {"Scalars:scalars": lists([1.0], pa.float64())}, steps(1))
    last = made.schema.field(len(made.schema) - 1)
    schema = made.schema.set(len(made.schema) - 1, last.with_metadata({**(last.metadata or {}), **fields}))
    return stream(pa.RecordBatch.from_arrays(made.columns, schema=schema))
