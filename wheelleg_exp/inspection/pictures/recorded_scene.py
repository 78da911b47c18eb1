"""The scene of a recording: shapes, poses, arrows and captions as plain arrays, from the recording alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.pictures.recorded_shapes import rgba_of, shapes_in
from wheelleg_exp.inspection.plots.plot_data import Array, Sample, Source, seconds
from wheelleg_exp.recording.layout import GROUND, ITERATION, OVERLAY, STEP, WORLD, join
from wheelleg_exp.recording.reading.plain import as_number
from wheelleg_exp.rendering.scene import Ground, Scene, points
from wheelleg_exp.rendering.shapes import FAR, Shape, moved

_ARROWS = {"actual": "velocity", "command": "commanded velocity"}


@dataclass(frozen=True)
class Arrows:
    """Arrows of one kind: a colour, a radius, m, and for each frame their origins and vectors, (k, 3), m."""

    name: str
    rgba: tuple[float, ...]
    radius: float
    origins: Sequence[Array]
    vectors: Sequence[Array]


@dataclass(frozen=True)
class Motion:
    """How the scene moves, frame by frame.

    Attributes:
        step: control steps, (n,).
        time: simulated time, s, (n,).
        iteration: training iterations, (n,), or None.
        pos: positions of the bodies, m, (n, B, 3).
        quat: their orientations, wxyz, (n, B, 4).
        arrows: what is drawn over the scene.
        commands: velocity command, by the name of each number, (n,).
    """

    step: NDArray[np.int64]
    time: Array
    iteration: NDArray[np.int64] | None
    pos: Array
    quat: Array
    arrows: Sequence[Arrows] = field(default=())
    commands: Mapping[str, Array] = field(default_factory=dict)

    def iteration_at(self, row: int) -> int | None:
        """Return the training iteration of a frame, None where there is none."""
        known = self.iteration is not None and self.iteration[row] >= 0
        return int(self.iteration[row]) if known and self.iteration is not None else None


def scene_of(source: Source) -> Scene:
    """Return the shapes of a recording.

    Raises:
        RunDirectoryError: the recording holds no robot.
    """
    bodies = {name: list(_shapes_below(source, source_body(source, name))) for name in _bodies(source)}
    if not any(bodies.values()):
        said = "".join(f": {event.text}" for event in source.recording.events("recording")[-1:])
        raise RunDirectoryError(
            f"'{source.recording.path}' holds no robot that moves{said}",
            expected="a recording of at least one whole step",
        )
    fixed = list(_shapes_below(source, f"{GROUND}/terrain"))
    offset = source.recording.static(f"{GROUND}/terrain").get("translation") or [[0.0, 0.0, 0.0]]
    terrain = [moved(shape, offset[0]) for shape in fixed]
    return Scene(bodies, terrain, _ground(source), _root(source, list(bodies)), _size(source, bodies))


def motion_of(source: Source, scene: Scene) -> Motion:
    """Return the recorded motion of a scene; a pose that is not finite is the last one that was.

    Raises:
        RunDirectoryError: the bodies have no step in common.
    """
    tables = _at_common_steps([source.recording.table(source_body(source, name)) for name in scene.bodies])
    first = tables[0]
    if not len(first):
        raise RunDirectoryError(
            f"the bodies of '{source.recording.path}' were never recorded at one step", expected="a whole recording"
        )
    step = np.asarray(first.column(STEP).combine_chunks())
    pos = np.stack([_last_finite(_vectors(t, "translation", 3)) for t in tables], axis=1)
    quat = np.stack([_last_finite(_vectors(t, "quaternion", 4)) for t in tables], axis=1)[..., [3, 0, 1, 2]]
    iteration = None
    if ITERATION in first.column_names:
        iteration = np.asarray(first.column(ITERATION).combine_chunks().cast(pa.int64()).fill_null(-1))
    arrows = list(_arrows(source, step))
    return Motion(step, seconds(first), iteration, pos, quat, arrows, _commands(source, step))


def source_body(source: Source, name: str) -> str:
    """Return the entity of a body."""
    return join(WORLD, source.branch, name)


def frames_of(motion: Motion, sample: Sample) -> NDArray[np.intp]:
    """Return the rows of a motion that belong to a sample."""
    return np.flatnonzero((motion.step >= sample.first) & (motion.step <= sample.last))


def _at_common_steps(tables: Sequence[pa.Table]) -> list[pa.Table]:
    """Return the rows of the steps that all have: a file that was cut off may end with the rows of some bodies."""
    steps = [np.asarray(table.column(STEP)) for table in tables]
    if all(np.array_equal(own, steps[0]) for own in steps):
        return list(tables)
    common = reduce(np.intersect1d, steps)
    return [table.take(np.searchsorted(own, common)) for table, own in zip(tables, steps, strict=True)]


def _bodies(source: Source) -> list[str]:
    root = join(WORLD, source.branch) if source.branch else WORLD
    return [name for name in source.children(root) if _has_poses(source, source_body(source, name))]


def _has_poses(source: Source, entity: str) -> bool:
    return source.has(entity) and {STEP, "translation", "quaternion"} <= source.recording.columns(entity)


def _root(source: Source, names: list[str]) -> int:
    """Return the base: by the recording's properties, else the body whose height is the recorded one's."""
    known = _property(source, "root")
    if known and str(known[0]) in names:
        return names.index(str(known[0]))
    height = source.maybe("base", "height")
    if height is None or not len(height.step):
        return 0
    lifts = [_vectors(source.recording.table(source_body(source, name)), "translation", 3)[:, 2] for name in names]
    distance = [float(np.abs(lift[: len(height.first)] - height.first[: len(lift)]).max()) for lift in lifts]
    return int(np.argmin(distance))


def _property(source: Source, name: str) -> list[Any]:
    properties = getattr(source.recording, "properties", {})
    robot = properties.get("robot", {}) if isinstance(properties, Mapping) else {}
    value = robot.get(name) if isinstance(robot, Mapping) else None
    return [] if value is None else (value if isinstance(value, list) else [value])


def _size(source: Source, bodies: Mapping[str, Sequence[Shape]]) -> float:
    height = as_number(next(iter(_property(source, "height")), None))
    if height is not None and 0.0 < height < FAR:
        return height
    tables = [source.recording.table(source_body(source, name)) for name in bodies]
    pos = np.stack([_vectors(t, "translation", 3)[0] for t in tables])
    quat = np.stack([_vectors(t, "quaternion", 4)[0] for t in tables])[:, [3, 0, 1, 2]]
    height = np.ptp(points(Scene(bodies, (), None, 0, 1.0), pos, quat)[:, 2])
    return max(float(height), 0.01)


def _shapes_below(source: Source, root: str) -> Iterator[Shape]:
    head = f"{root}/"
    for entity in source.recording.entities():
        tail = entity.removeprefix(head)
        if entity.startswith(head) and "/" not in tail.replace("\\/", ""):
            yield from shapes_in(source.recording.static(entity), source.recording.archetypes(entity))


def _ground(source: Source) -> Ground | None:
    statics = source.recording.static(GROUND)
    vertices = np.asarray(statics.get("vertex_positions") or [], dtype=np.float64)
    if len(vertices) < 2 or not source.has(GROUND) or "translation" not in source.recording.columns(GROUND):
        return None
    height = float(_vectors(source.recording.table(GROUND), "translation", 3)[-1, 2])
    tile = float(np.linalg.norm(vertices[1] - vertices[0]))
    return Ground(height, tile) if abs(height) < FAR and 0.0 < tile < FAR else None


def _arrows(source: Source, step: NDArray[np.int64]) -> Iterator[Arrows]:
    root = join(OVERLAY, source.branch) if source.branch else OVERLAY
    for group in ("contacts", "velocity"):
        for name in source.children(f"{root}/{group}"):
            entity = f"{root}/{group}/{join(name)}"
            if source.has(entity) and {STEP, "origins", "vectors"} <= source.recording.columns(entity):
                yield _arrows_at(source, entity, _ARROWS.get(name, "contact force"), step)


def _arrows_at(source: Source, entity: str, name: str, step: NDArray[np.int64]) -> Arrows:
    table, statics = source.recording.table(entity), source.recording.static(entity)
    rows = {int(s): i for i, s in enumerate(np.asarray(table.column(STEP)))}
    pairs = [_pairs(*ends) for ends in zip(*(_ragged(table, name) for name in ("origins", "vectors")), strict=True)]
    origins, vectors = ([pair[i] for pair in pairs] for i in (0, 1))
    empty = np.empty((0, 3))

    def of(values: list[Array]) -> list[Array]:
        return [values[rows[int(s)]] if int(s) in rows else empty for s in step]

    radius = float((statics.get("radii") or [0.002])[0])
    return Arrows(name, rgba_of((statics.get("colors") or [None])[0]), radius, of(origins), of(vectors))


def _pairs(origins: Array, vectors: Array) -> tuple[Array, Array]:
    """Return the arrows that have both ends."""
    count = min(len(origins), len(vectors))
    both = np.concatenate((origins[:count], vectors[:count]), axis=1)
    both = both[(np.abs(both) < FAR).all(axis=1)]
    return both[:, :3], both[:, 3:]


def _commands(source: Source, step: NDArray[np.int64]) -> dict[str, Array]:
    for command in source.below("commands"):
        found = {name: source.maybe("commands", command, name) for name in ("v_x", "v_y", "w_z")}
        known = {name: series for name, series in found.items() if series is not None}
        if known:
            return {n: np.interp(step, s.step, s.first) if len(s.step) else s.first for n, s in known.items()}
    return {}


def _vectors(table: pa.Table, name: str, width: int) -> Array:
    """Return the first vector of each row of a component, (n, width); NaN where a row has none."""
    rows = [row[:1] if len(row) else np.full((1, width), np.nan) for row in _ragged(table, name, width)]
    return np.concatenate(rows) if rows else np.empty((0, width))


def _ragged(table: pa.Table, name: str, width: int = 3) -> list[Array]:
    """Return a component that holds any number of vectors a row, (k, width) each."""
    column = table.column(name).combine_chunks()
    lengths = np.asarray(pc.fill_null(pc.list_value_length(column), 0), dtype=np.int64)
    flat = np.asarray(column.flatten().flatten(), dtype=np.float64)
    return np.split(flat.reshape(-1, width), np.cumsum(lengths)[:-1]) if len(lengths) else []


def _last_finite(rows: Array) -> Array:
    fine = (np.abs(rows) < FAR).all(axis=1)
    if fine.all() or not fine.any():
        return np.where(np.abs(rows) < FAR, rows, 0.0)
    last = np.maximum.accumulate(np.where(fine, np.arange(len(rows)), np.argmax(fine)))
    return rows[last]
