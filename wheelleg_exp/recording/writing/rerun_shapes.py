"""Convert the MuJoCo model and the recorded frames to Rerun's shapes: geoms, body poses, arrows, the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr

from wheelleg_exp.recording.layout import GROUND, EnvPaths
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.rendering.scene_models import colour, mesh
from wheelleg_exp.sim.robot import Robot


def default_pose(robot: Robot, model: mujoco.MjModel) -> Array:
    """Return qpos (nq,) with every joint at its default position and the base at its pose in the MuJoCo model."""
    qpos: Array = model.qpos0.copy()
    for joint, position in zip(robot.joint_names, robot.layout.default_joint_pos.flatten().tolist(), strict=True):
        qpos[model.joint(joint).qposadr[0]] = position
    return qpos


def weight(model: mujoco.MjModel, root: int) -> float:
    """Return the weight of a MuJoCo body and all its descendants, N; 1 N if mass or gravity is 0."""
    weight = float(model.body_subtreemass[root] * np.linalg.norm(model.opt.gravity))
    return weight if weight > 0 else 1.0


def roll_pitch_yaw(quaternion: Array) -> Array:
    """Return roll, pitch, and yaw (n, 3), rad, of R = Rz(yaw) Ry(pitch) Rx(roll) for unit quaternions (n, 4), wxyz."""
    w, x, y, z = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    return np.stack((roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))), axis=1)


def xyzw(wxyz: Array) -> Array:
    """Return quaternions (..., 4) in Rerun's order (x, y, z, w) from MuJoCo's (w, x, y, z)."""
    return np.roll(wxyz, -1, axis=-1)


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a MuJoCo geom, or ``geom_<number>`` for a geom without a name."""
    return model.geom(geom).name or f"geom_{geom}"


def shape(model: mujoco.MjModel, geom: int) -> list[rr.AsComponents]:
    """Return Rerun's archetypes of a MuJoCo geom in its body's frame; [] for a plane or signed distance field.

    MuJoCo's sizes are half sizes. A capsule's origin is its centre in MuJoCo, and the centre of one cap in Rerun.
    """
    kind, place, turn = int(model.geom_type[geom]), model.geom_pos[geom], [xyzw(model.geom_quat[geom])]
    size, shade, types = model.geom_size[geom], [colour(model, geom)], mujoco.mjtGeom
    if kind in (types.mjGEOM_MESH, types.mjGEOM_HFIELD):
        corners, faces, normals = mesh(model, geom)
        surface = rr.Mesh3D(
            vertex_positions=corners, triangle_indices=faces, vertex_normals=normals, albedo_factor=shade[0]
        )
        return [surface, rr.InstancePoses3D(translations=[place], quaternions=turn)]
    if kind == types.mjGEOM_BOX:
        return [rr.Boxes3D(half_sizes=[size], centers=[place], quaternions=turn, colors=shade, fill_mode="solid")]
    if kind in (types.mjGEOM_SPHERE, types.mjGEOM_ELLIPSOID):
        half = np.full(3, size[0]) if kind == types.mjGEOM_SPHERE else size
        return [rr.Ellipsoids3D(half_sizes=[half], centers=[place], quaternions=turn, colors=shade, fill_mode="solid")]
    lengths, radii = [2 * size[1]], [size[0]]
    if kind == types.mjGEOM_CYLINDER:
        return [
            rr.Cylinders3D(
                lengths=lengths, radii=radii, centers=[place], quaternions=turn, colors=shade, fill_mode="solid"
            )
        ]
    if kind == types.mjGEOM_CAPSULE:
        axis = np.zeros(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
        cap = [place - size[1] * axis]
        return [
            rr.Capsules3D(
                lengths=lengths, radii=radii, translations=cap, quaternions=turn, colors=shade, fill_mode="solid"
            )
        ]
    return []


COMMANDED, ACTUAL, FORCE = (60, 200, 90), (70, 130, 255), (255, 170, 40)
ANGLES = ("roll", "pitch", "yaw")
Columns = tuple[str, rr.ComponentColumnList]
Blocks = Mapping[str, Array]


def vector_columns(rows: Array) -> rr.ComponentColumnList:
    """Convert an array (n, width) to n vectors in the column format of Rerun's SDK."""
    flat = rr.Scalars.columns(scalars=np.ascontiguousarray(rows).ravel())
    return flat if rows.shape[1] == 1 else flat.partition([rows.shape[1]] * len(rows))


@dataclass(frozen=True)
class Contacts:
    """Draws the contact forces of a sensor as numbers, and as arrows of ``scale`` m per N at ``bodies`` (ids)."""

    sensor: str
    bodies: tuple[int, ...]
    scale: float

    def columns(self, paths: EnvPaths, blocks: Blocks) -> Iterator[Columns]:
        """Yield the norms of the contact forces, N, and force arrows that start at the bodies' origins."""
        force = blocks[f"contacts/{self.sensor}"].reshape(-1, len(self.bodies), 3)
        norm = np.linalg.norm(force, axis=2)
        yield paths.data("contacts", self.sensor), vector_columns(norm)
        position = blocks["xpos"][:, list(self.bodies)]
        touching = norm > 0
        arrows = rr.Arrows3D.columns(origins=position[touching], vectors=self.scale * force[touching])
        yield paths.overlay("contacts", self.sensor), arrows.partition(touching.sum(axis=1))


@dataclass(frozen=True)
class VelocityArrows:
    """Draws arrows above the base for the commanded and the actual planar velocity.

    ``command`` is the key of the buffered velocity command; ``root`` is the MuJoCo body id of the base. ``lift`` is the
    height of the velocity arrows above the base, m. ``scale`` is the length of a velocity arrow, in m per m/s.
    """

    command: str
    root: int
    lift: float
    scale: float

    def columns(self, paths: EnvPaths, blocks: Blocks) -> Iterator[Columns]:
        """Yield for each frame one arrow for the velocity command and one arrow for the robot's velocity."""
        origin, yaw = blocks["xpos"][:, self.root] + [0.0, 0.0, self.lift], blocks["orientation"][:, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        for name, velocity in (("command", blocks[self.command]), ("actual", blocks["lin_vel"])):
            # Rotate the planar velocity from the base's yaw frame to the world frame.
            x, y = velocity[:, 0], velocity[:, 1]
            vectors = self.scale * np.stack((c * x - s * y, s * x + c * y, np.zeros_like(x)), axis=1)
            yield paths.overlay("velocity", name), rr.Arrows3D.columns(origins=origin, vectors=vectors)


@dataclass(frozen=True)
class Ground:
    """Draws a checkered ground that moves with the robot by whole tiles, so that the ground looks infinite.

    ``root`` is the base's body id, ``tile`` the edge length of a tile, m. ``tiles``, the number along an edge, must be
    even. ``origin`` is the point of the ground plane below the environment's origin, m.
    """

    root: int
    tile: float
    tiles: int
    origin: Array

    def mesh(self, light: Sequence[int], dark: Sequence[int]) -> rr.Mesh3D:
        """Return the mesh of the checkered ground below the robot, with the origin at the centre of the mesh."""
        i, j = (axis.ravel() for axis in np.meshgrid(np.arange(self.tiles), np.arange(self.tiles)))
        corner = np.stack((i, j), axis=1) - self.tiles / 2
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        flat = ((corner[:, None] + square) * self.tile).reshape(-1, 2)
        first = 4 * np.arange(len(i))[:, None]
        triangles = np.concatenate((first + np.array([0, 1, 2]), first + np.array([0, 2, 3])))
        shades = np.where(((i + j) % 2 == 0)[:, None], light, dark).astype(np.uint8)
        corners, normals = np.column_stack((flat, np.zeros(len(flat)))), np.tile([0.0, 0.0, 1.0], (len(flat), 1))
        colours = np.repeat(shades, 4, axis=0)
        return rr.Mesh3D(
            vertex_positions=corners, triangle_indices=triangles, vertex_normals=normals, vertex_colors=colours
        )

    def columns(self, blocks: Blocks) -> Iterator[Columns]:
        """Yield the ground patch's position: a multiple of two tiles near the base, so that colours do not flip."""
        step = 2 * self.tile
        snapped = step * np.round(np.nan_to_num(blocks["xpos"][:, self.root, :2]) / step)
        translation = np.column_stack((snapped, np.full(len(snapped), self.origin[2])))
        yield GROUND, rr.Transform3D.columns(translation=translation)
