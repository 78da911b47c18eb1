"""Picture of a robot's initial state: colliders, centre of mass, support polygon, and overlapping bodies."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wheelleg_exp.anatomy.collider_shapes import colliders, find_overlaps
from wheelleg_exp.anatomy.compiled_robot import CompiledRobot
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import require_new, write_new
from wheelleg_exp.inspection import recorded_scene
from wheelleg_exp.rendering import render_scene
from wheelleg_exp.rendering.render_job import Order, View
from wheelleg_exp.rendering.render_scene import Ground, Scene, Shape, points
from wheelleg_exp.rendering.renderer import drawing
from wheelleg_exp.rendering.scene_models import shape_of

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 720, 720  # Each of the two views of the robot is 720 px wide and high.
_FINER = 2
_SAMPLES = 4
_GREY, _WHEEL, _INSIDE = (0.62, 0.65, 0.7, 0.45), (0.25, 0.28, 0.33, 0.75), (0.95, 0.5, 0.1, 0.6)
_MASS, _SUPPORT, _CONTACT = (0.85, 0.1, 0.15, 1.0), (0.1, 0.55, 0.25, 1.0), (0.1, 0.35, 0.85, 1.0)
_BALL, _ROD = 0.025, 0.006  # A marker sphere has a radius of 2.5 % of the robot's size, a rod 0.6 %.


def require_picture(path: Path) -> None:
    """Raise RunDirectoryError if a picture's path does not end with .png or its file already exists."""
    if path.suffix.lower() != ".png":
        expected = "a name that ends with .png"
        raise RunDirectoryError(f"'{path}' has no image suffix", key="--screenshot", expected=expected)
    require_new(path)


def write_picture(robot: CompiledRobot, path: Path) -> None:
    """Write a picture of a robot atomically, with a view from the side and a view from the front."""
    require_picture(path)
    size = robot.anatomy.size
    scene = Scene({"robot": [*_colliders(robot), *_marks(robot)]}, (), Ground(0.0, size / 4), 0, size)
    place, upright = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    cloud = points(scene, place, upright)
    lookat = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    distance = render_scene.camera_distance(cloud - lookat, _WIDTH / _HEIGHT)
    base = robot.model.body(robot.anatomy.base).id
    left = robot.data.xmat[base].reshape(3, 3) @ np.array(robot.anatomy.left or (0.0, 1.0, 0.0))
    # In the side view, the camera is to the right of the robot, so that the robot faces right in the image.
    side = float(np.degrees(np.arctan2(left[1], left[0])))
    pictures = []
    with drawing(Order(scene, _FINER * _WIDTH, _FINER * _HEIGHT, _SAMPLES)) as process:
        for azimuth, elevation in ((side, 0.0), (render_scene.AZIMUTH, render_scene.ELEVATION)):
            view = View(place, upright, (), lookat, distance, azimuth, elevation)
            image = Image.fromarray(process.draw(view)).resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)
            pictures.append(np.asarray(image))
    legend = {"centre of mass": _MASS, "support": _SUPPORT, "contacts": _CONTACT, "inside another body": _INSIDE}
    drawn = recorded_scene.write_caption(np.hstack(pictures), ["from the right; from ahead"], legend)
    buffer = io.BytesIO()
    Image.fromarray(drawn).save(buffer, "PNG", optimize=True)
    write_new(path, buffer.getvalue())


def _colliders(robot: CompiledRobot) -> list[Shape]:
    model, data = robot.model, robot.data
    wheels = {model.body(name).id for wheel in robot.anatomy.wheels for name in wheel.bodies}
    pairs = find_overlaps(model, data.qpos, robot.bodies)
    inside = {model.body(name).id for pair in pairs if not pair.neighbours for name in pair.bodies}
    shapes = []
    for geom in colliders(model, [model.body(name).id for name in robot.bodies]):
        body = int(model.geom_bodyid[geom])
        rgba = _INSIDE if body in inside else _WHEEL if body in wheels else _GREY
        quat, shape = np.zeros(4), shape_of(model, geom)
        mujoco.mju_mat2Quat(quat, data.geom_xmat[geom])
        if shape is not None:
            shapes.append(replace(shape, pos=tuple(data.geom_xpos[geom]), quat=tuple(quat), rgba=rgba))
    return shapes


def _marks(robot: CompiledRobot) -> list[Shape]:
    """Return a robot's markers: centre of mass, its plumb line, contact points of the wheels, and support polygon."""
    model, data, anatomy = robot.model, robot.data, robot.anatomy
    base, size = model.body(anatomy.base).id, anatomy.size
    frame, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
    contacts = [origin + frame @ np.array(wheel.contact) for wheel in anatomy.standing]
    mass = data.subtree_com[base]
    ground = min((float(contact[2]) for contact in contacts), default=0.0)
    shapes = [_ball(mass, _BALL * size, _MASS), _rod(mass, np.array([mass[0], mass[1], ground]), size, _MASS)]
    shapes += [_ball(contact, 0.7 * _BALL * size, _CONTACT) for contact in contacts]
    middle = np.mean(contacts, axis=0) if contacts else np.zeros(3)
    around = sorted(contacts, key=lambda point: float(np.arctan2(point[1] - middle[1], point[0] - middle[0])))
    ends = zip(around, around[1:] + around[:1], strict=True)
    return shapes + [_rod(a, b, size, _SUPPORT) for a, b in ends if np.linalg.norm(a - b) > 0]


def _ball(place: Array, radius: float, rgba: tuple[float, ...]) -> Shape:
    return Shape("ellipsoid", (radius,) * 3, tuple(place), (1.0, 0.0, 0.0, 0.0), rgba)


def _rod(one: Array, other: Array, size: float, rgba: tuple[float, ...]) -> Shape:
    quat, half = np.zeros(4), float(np.linalg.norm(other - one)) / 2
    mujoco.mju_quatZ2Vec(quat, (other - one) / max(2 * half, 1e-12))
    return Shape("capsule", (_ROD * size, half), tuple((one + other) / 2), tuple(quat), rgba)
