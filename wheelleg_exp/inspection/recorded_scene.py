"""Scene of a recording as plain arrays: shapes, poses, arrows, camera, and captions, from the recording alone."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.plot_data import Numbers, Sample, Source, seconds
from wheelleg_exp.recording.layout import GROUND, ITERATION, OVERLAY, STEP, WORLD, join
from wheelleg_exp.recording.reading.arrow_values import as_number
from wheelleg_exp.rendering import render_scene
from wheelleg_exp.rendering.render_scene import FAR, Array, Ground, Scene, Shape, moved, points, rotated

_GREY = (0.6, 0.62, 0.65, 1.0)
_IDENTITY = (1.0, 0.0, 0.0, 0.0)
Statics = Mapping[str, list[object]]


def _is_drawable(shape: Shape) -> bool:
    numbers = np.asarray([*shape.size, *shape.pos], dtype=np.float64)
    if shape.vertices is None or shape.faces is None:
        return bool((np.abs(numbers) < FAR).all())
    corners, faces = np.append(shape.vertices.ravel(), numbers), shape.faces
    return bool(faces.size and (np.abs(corners) < FAR).all() and faces.max() < len(shape.vertices))


def _solids(statics: Statics, archetypes: Collection[str]) -> Iterator[Shape]:
    tubes = min(len(statics.get(name) or ()) for name in ("radii", "lengths"))
    for i in range(len(statics.get("half_sizes") or ()) or tubes):
        pos = _at(statics, ("centers", "translations"), i, (0.0, 0.0, 0.0))
        quat = _wxyz(_at(statics, ("quaternions",), i, (0.0, 0.0, 0.0, 1.0)))
        colours = statics.get("colors") or [None]
        rgba = rgba_of(colours[min(i, len(colours) - 1)])
        if "half_sizes" in statics:  # In Rerun, boxes and ellipsoids both have the component `half_sizes`.
            kind = "ellipsoid" if "Ellipsoids3D" in archetypes else "box"
            yield Shape(kind, _at(statics, ("half_sizes",), i, ()), pos, quat, rgba)
            continue
        radius, length = (*_at(statics, ("radii",), i, ()), *_at(statics, ("lengths",), i, ()))
        half = length / 2
        if "centers" in statics:
            yield Shape("cylinder", (radius, half), pos, quat, rgba)
        else:
            # Rerun places a capsule by the centre of one cap, MuJoCo by the centre of the whole capsule.
            centre = np.asarray(pos) + rotated(quat, np.array([0.0, 0.0, half]))
            yield Shape("capsule", (radius, half), tuple(centre.tolist()), quat, rgba)


def _meshes(statics: Statics) -> Iterator[Shape]:
    vertices = np.asarray(statics["vertex_positions"], dtype=np.float64)
    own = np.arange(len(vertices) - len(vertices) % 3)
    faces = np.asarray(statics.get("triangle_indices") or own, dtype=np.int64).reshape(-1, 3)
    given = statics.get("vertex_normals")
    normals = np.asarray(given, dtype=np.float64) if given is not None and len(given) == len(vertices) else None
    shade = rgba_of((statics.get("albedo_factor") or [None])[0])
    for i in range(max(1, len(statics.get("translations") or []))):
        pos = _at(statics, ("translations",), i, (0.0, 0.0, 0.0))
        quat = _wxyz(_at(statics, ("quaternions",), i, (0.0, 0.0, 0.0, 1.0)))
        yield Shape("mesh", (), pos, quat, shade, vertices, faces, normals)


def _at(statics: Statics, names: Sequence[str], i: int, otherwise: tuple[float, ...]) -> tuple[float, ...]:
    """Return the numbers in row ``i``, or else in the last row, of the first component in ``names`` that has rows."""
    values = next(filter(None, map(statics.get, names)), None) or [otherwise]
    return tuple(np.asarray(values[min(i, len(values) - 1)], dtype=float).ravel().tolist())


def rgba_of(packed: object) -> tuple[float, ...]:
    """Return the RGBA components, 0 to 1, of a colour 0xRRGGBBAA; grey for None."""
    return tuple(((packed >> shift) & 255) / 255 for shift in (24, 16, 8, 0)) if isinstance(packed, int) else _GREY


def _wxyz(xyzw: tuple[float, ...]) -> tuple[float, ...]:
    x, y, z, w = xyzw
    return (w, x, y, z) if np.isfinite((x, y, z, w)).all() and (x, y, z, w) != (0, 0, 0, 0) else _IDENTITY


_ARROWS = {"actual": "velocity", "command": "commanded velocity"}


@dataclass(frozen=True)
class Arrows:
    """Arrows of one kind: colour, radius (m), and for each frame their origins and vectors, (k, 3), m."""

    name: str
    rgba: tuple[float, ...]
    radius: float
    origins: Sequence[Numbers]
    vectors: Sequence[Numbers]


@dataclass(frozen=True)
class Motion:
    """The recorded poses of the robot's bodies in each of n frames.

    ``step``, ``time`` (s), and ``iteration`` (None without a training) are arrays (n,). ``pos`` (n, B, 3) is in m;
    ``quat`` (n, B, 4) is wxyz. ``commands`` maps each component of the velocity command to an array (n,).
    """

    step: NDArray[np.int64]
    time: Numbers
    iteration: NDArray[np.int64] | None
    pos: Numbers
    quat: Numbers
    arrows: Sequence[Arrows] = field(default=())
    commands: Mapping[str, Numbers] = field(default_factory=dict)

    def iteration_at(self, row: int) -> int | None:
        """Return the training iteration of a recorded frame; None if no training was recorded."""
        return int(self.iteration[row]) if self.iteration is not None and self.iteration[row] >= 0 else None


def scene_of(source: Source) -> Scene:
    """Return the drawable scene of a recording. Raise RunDirectoryError for a recording without a moving robot."""
    moving = {STEP, "translation", "quaternion"}
    names = source.children(join(WORLD, source.branch) if source.branch else WORLD)
    entities = {name: entity for name in names if source.recording.has_rows(entity := source_body(source, name))}
    entities = {name: entity for name, entity in entities.items() if moving <= source.recording.columns(entity)}
    bodies = {name: list(_shapes_below(source, entity)) for name, entity in entities.items()}
    if not any(bodies.values()):
        reason = "".join(f": {event.text}" for event in source.recording.events("recording")[-1:])
        message = f"'{source.recording.path}' contains no moving robot{reason}"
        raise RunDirectoryError(message, expected="a recording of at least one whole step")
    # Poses are relative to the origin of their own environment; the recorded offset is that of the first environment.
    origin = source.recording.static(join(source.branch, "state")).get("origin") or (0.0, 0.0, 0.0)
    offset = -np.asarray(origin, dtype=np.float64)
    terrain = [moved(shape, offset) for shape in _shapes_below(source, f"{GROUND}/terrain")]
    # The tile of the checkered ground is the edge between the first two corners of the recorded mesh.
    corners = np.asarray(source.recording.static(GROUND).get("vertex_positions") or [], dtype=np.float64)
    ground = None
    if len(corners) > 1 and source.recording.has_rows(GROUND) and "translation" in source.recording.columns(GROUND):
        height = float(_vectors(source.recording.table(GROUND), "translation", 3)[-1, 2])
        tile = float(np.linalg.norm(corners[1] - corners[0]))
        ground = Ground(height, tile) if abs(height) < FAR and 0.0 < tile < FAR else None
    return Scene(bodies, terrain, ground, _root(source, list(bodies)), _size(source, bodies))


def motion_of(source: Source, scene: Scene) -> Motion:
    """Return the recorded motion of a scene, in which the last finite pose replaces NaN and inf."""
    tables = [source.recording.table(source_body(source, name)) for name in scene.bodies]
    # Use only control steps with recorded poses of all bodies, because a truncated recording can lack some poses.
    steps = [np.asarray(table.column(STEP)) for table in tables]
    if not all(np.array_equal(own, steps[0]) for own in steps):
        common = reduce(np.intersect1d, steps)
        tables = [table.take(np.searchsorted(own, common)) for table, own in zip(tables, steps, strict=True)]
    first = tables[0]
    if not len(first):
        message = f"the bodies of '{source.recording.path}' have no common step"
        raise RunDirectoryError(message, expected="a complete recording")
    step = np.asarray(first.column(STEP).combine_chunks())
    # Rerun stores quaternions as xyzw; MuJoCo and this project use wxyz.
    pos = np.stack([_last_finite(_vectors(t, "translation", 3)) for t in tables], axis=1)
    quat = np.stack([_last_finite(_vectors(t, "quaternion", 4)) for t in tables], axis=1)[..., [3, 0, 1, 2]]
    iteration = None
    if ITERATION in first.column_names:
        iteration = np.asarray(first.column(ITERATION).combine_chunks().cast(pa.int64()).fill_null(-1))
    return Motion(step, seconds(first), iteration, pos, quat, _arrows(source, step), _commands(source, step))


def source_body(source: Source, name: str) -> str:
    """Return the Rerun entity path of a robot's body."""
    return join(WORLD, source.branch, name)


def frames_of(motion: Motion, sample: Sample) -> NDArray[np.intp]:
    """Return the indices of those frames of a motion that belong to one recorded interval (sample)."""
    return np.flatnonzero((motion.step >= sample.first) & (motion.step <= sample.last))


def _root(source: Source, names: list[str]) -> int:
    """Return the index of the base body; if its name was not recorded, find the body at the base's recorded height."""
    known = _property(source, "root")
    if known and str(known[0]) in names:
        return names.index(str(known[0]))
    height = source.maybe("base", "height")
    if height is None or not len(height.step):
        return 0
    lifts = [_vectors(source.recording.table(source_body(source, name)), "translation", 3)[:, 2] for name in names]
    distance = [float(np.abs(lift[: len(height.first)] - height.first[: len(lift)]).max()) for lift in lifts]
    return int(np.argmin(distance))


def _property(source: Source, name: str) -> list[object]:
    value = source.recording.properties.get("robot", {}).get(name)
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
        if entity.startswith(head):  # The names of the ground's geoms contain slashes.
            statics, archetypes = source.recording.static(entity), source.recording.archetypes(entity)
            shapes = _meshes(statics) if "vertex_positions" in statics else _solids(statics, archetypes)
            yield from filter(_is_drawable, shapes)


def _arrows(source: Source, step: NDArray[np.int64]) -> list[Arrows]:
    root = join(OVERLAY, source.branch) if source.branch else OVERLAY
    named = [(f"{root}/{g}/{join(n)}", n) for g in ("contacts", "velocity") for n in source.children(f"{root}/{g}")]
    found = []
    for entity, name in named:
        if source.recording.has_rows(entity) and {STEP, "origins", "vectors"} <= source.recording.columns(entity):
            table, statics = source.recording.table(entity), source.recording.static(entity)
            by_step = {}
            arrows = zip(_ragged(table, "origins"), _ragged(table, "vectors"), strict=True)
            for own, (starts, ends) in zip(np.asarray(table.column(STEP)), arrows, strict=True):
                count = min(len(starts), len(ends))
                both = np.concatenate((starts[:count], ends[:count]), axis=1)
                by_step[int(own)] = both[(np.abs(both) < FAR).all(axis=1)]
            rows = [by_step.get(int(s), np.empty((0, 6))) for s in step]
            rgba, (radius, *_) = rgba_of((statics.get("colors") or [None])[0]), _at(statics, ("radii",), 0, (0.002,))
            label = _ARROWS.get(name, "contact force")
            found.append(Arrows(label, rgba, radius, [row[:, :3] for row in rows], [row[:, 3:] for row in rows]))
    return found


def _commands(source: Source, step: NDArray[np.int64]) -> dict[str, Numbers]:
    for command in source.below("commands"):
        found = {name: source.maybe("commands", command, name) for name in ("v_x", "v_y", "w_z")}
        known = {name: series for name, series in found.items() if series is not None}
        if known:
            return {n: np.interp(step, s.step, s.first) if len(s.step) else s.first for n, s in known.items()}
    return {}


def _vectors(table: pa.Table, name: str, width: int) -> Numbers:
    """Return the first vector of each of n table rows, (n, width); NaN for an empty row."""
    rows = [row[:1] if len(row) else np.full((1, width), np.nan) for row in _ragged(table, name, width)]
    return np.concatenate(rows) if rows else np.empty((0, width))


def _ragged(table: pa.Table, name: str, width: int = 3) -> list[Numbers]:
    column = table.column(name).combine_chunks()
    lengths = np.asarray(pc.fill_null(pc.list_value_length(column), 0), dtype=np.int64)
    flat = np.asarray(column.flatten().flatten(), dtype=np.float64)
    return np.split(flat.reshape(-1, width), np.cumsum(lengths)[:-1]) if len(lengths) else []


def _last_finite(rows: Numbers) -> Numbers:
    fine = (np.abs(rows) < FAR).all(axis=1)
    if fine.all() or not fine.any():
        return np.where(np.abs(rows) < FAR, rows, 0.0)
    # Replace a recorded pose with NaN or inf by the last finite pose before it, or else by the first finite pose.
    return rows[np.maximum.accumulate(np.where(fine, np.arange(len(rows)), np.argmax(fine)))]


_SMOOTH_S = 0.2
_LOOKED_AT = 12


@dataclass(frozen=True)
class Camera:
    """A camera with constant direction and distance (m) that follows the point ``lookat``, (n, 3), m, over n frames."""

    distance: float
    lookat: Array


def follow_robot(scene: Scene, motion: Motion, rows: NDArray[np.intp], aspect: float) -> Camera:
    """Return a camera that follows the robot in the frames ``rows``; ``aspect`` is a picture's width by height."""
    root = motion.pos[rows, scene.root]
    seen = rows[np.linspace(0, len(rows) - 1, min(len(rows), _LOOKED_AT)).round().astype(int)]
    clouds = [points(scene, motion.pos[i], motion.quat[i]) - motion.pos[i, scene.root] for i in seen]
    low = np.median([cloud.min(axis=0) for cloud in clouds], axis=0)
    high = np.median([cloud.max(axis=0) for cloud in clouds], axis=0)
    centre = np.array([0.0, 0.0, (low[2] + high[2]) / 2])
    distance = max(render_scene.camera_distance(cloud - centre, aspect) for cloud in clouds)
    # Smooth the camera's path only between resets, because a reset moves the robot to another place.
    cuts = np.flatnonzero(np.linalg.norm(np.diff(root, axis=0), axis=1) > scene.size) + 1
    parts, time = np.split(np.arange(len(root)), cuts), motion.time[rows]
    path = np.concatenate([_gauss(root[part], time[part]) for part in parts if len(part)])
    return Camera(distance, path + centre)


def _gauss(path: Array, time: Array) -> Array:
    if len(path) < 3:
        return path
    spacing = max(float(np.median(np.diff(time))), 1e-6)
    reach = max(1, int(np.ceil(3 * _SMOOTH_S / spacing)))
    return np.asarray(gaussian_filter1d(path, _SMOOTH_S / spacing, axis=0, mode="nearest", radius=reach))


_INK, _BACK = (31, 41, 51, 255), (255, 255, 255, 205)
_COMMANDS = (("v_x", "forward", "m/s"), ("v_y", "sideways", "m/s"), ("w_z", "turning", "rad/s"))


def caption_lines(motion: Motion, row: int, env_id: int | None = None) -> list[str]:
    """Return the caption of a frame: environment, iteration, time, and a command that is not always zero."""
    facts = [f"t = {motion.time[row]:.2f} s"]
    if (iteration := motion.iteration_at(row)) is not None:
        facts.insert(0, f"iteration {iteration}")
    if env_id is not None:
        facts.insert(0, f"environment {env_id}")
    command = [
        f"{word} {motion.commands[name][row]:+.2f} {unit}"
        for name, word, unit in _COMMANDS
        if name in motion.commands and np.any(np.abs(np.nan_to_num(motion.commands[name])) > 1e-9)
    ]
    return [" · ".join(facts), *(["command: " + ", ".join(command)] if command else [])]


def arrow_legend(motion: Motion) -> dict[str, tuple[float, ...]]:
    """Return the label and the colour of each kind of arrow in a motion, except arrows whose length is always 0."""
    return {a.name: a.rgba for a in motion.arrows if any(np.abs(v).max(initial=0.0) > 0 for v in a.vectors)}


def write_caption(
    pixels: NDArray[np.uint8], texts: Sequence[str], colours: Mapping[str, tuple[float, ...]]
) -> NDArray[np.uint8]:
    """Add texts to the lower left corner of a picture (h, w, 3), and a legend of arrows to the lower right corner."""
    image = Image.fromarray(pixels).convert("RGBA")
    layer = Image.new("RGBA", image.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    size = max(11, round(min(image.height / 34, image.width / 46)))
    font = ImageFont.truetype(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)
    pad, step = round(0.55 * size), round(1.35 * size)
    height = image.height
    if texts:
        width = max(draw.textlength(text, font) for text in texts)
        top = height - 3 * pad - len(texts) * step
        draw.rounded_rectangle((pad, top, width + 3 * pad, height - pad), round(0.6 * pad), fill=_BACK)
        for i, text in enumerate(texts):
            draw.text((2 * pad, top + 0.6 * pad + i * step), text, _INK, font)
    if colours:
        right = image.width - pad
        left = right - max(draw.textlength(name, font) for name in colours) - 1.6 * size - 2 * pad
        top = height - 3 * pad - len(colours) * step
        draw.rounded_rectangle((left, top, right, height - pad), round(0.6 * pad), fill=_BACK)
        for i, (name, rgba) in enumerate(colours.items()):
            y = top + 0.6 * pad + i * step
            shade, middle = tuple(round(255 * part) for part in rgba[:3]), y + 0.62 * size
            draw.line((left + pad, middle, left + pad + 1.1 * size, middle), (*shade, 255), max(2, round(size / 5)))
            draw.text((left + pad + 1.6 * size, y), name, _INK, font)
    return np.asarray(Image.alpha_composite(image, layer).convert("RGB"))
