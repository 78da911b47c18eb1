"""Mass properties of bodies by the rules of UsdPhysics and PhysX: what is authored, else what the colliders weigh."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from wheelleg_exp.asset.description import Inertial, Quat, Vec3
from wheelleg_exp.asset.geometry import Array, apply, plain_float, quaternion, rotation_matrix, vec3
from wheelleg_exp.asset.solids import (
    BARE_MASS,
    BARE_RADIUS,
    Part,
    balanced,
    combined_center,
    combined_tensor,
    principal,
)
from wheelleg_exp.asset.usd.bodies.collider_mass import NO_DENSITY, parts_of
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link
from wheelleg_exp.asset.usd.mjc.angles import find_scene
from wheelleg_exp.asset.usd.shapes.colliders import Piece
from wheelleg_exp.asset.usd.stage import Stage
from wheelleg_exp.asset.usd.units import given
from wheelleg_exp.errors import AssetError

SMALLEST = 1e-15  # kg, kg m²; MuJoCo refuses less on bodies that move


def inertial_of(stage: Stage, link: Link, pieces: Iterable[Piece], welded: bool = False) -> Inertial:
    """Return a body's mass, centre and principal moments.

    Args:
        stage: the open stage.
        link: the body.
        pieces: its shapes; those with a carrier count, switched off or not.
        welded: whether nothing moves it in its parent, so that MuJoCo lets it weigh nothing.

    Raises:
        AssetError: the mass is too small for MuJoCo.
    """
    authored, center, moments = _authored_mass(stage, link), _center(stage, link), _authored_moments(stage, link)
    parts: list[Part] = []
    if authored is None or center is None or moments is None:  # the colliders say what the file does not
        parts = parts_of(stage, link, pieces)
    if authored is None and not parts and moments is None and welded and find_scene(stage) is not None:
        stage.ledger.assume(link.path, "no mass and no collider: none, as MuJoCo", "0 kg")
        return Inertial(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    mass = _computed_mass(stage, link, parts) if authored is None else authored
    if mass < SMALLEST and not welded:
        raise AssetError(f"a mass of {mass:g} kg is too small", key=link.path, expected=f"more than {SMALLEST:g} kg")
    if center is None:
        center = combined_center(parts)
        if parts:
            stage.ledger.assume(link.path, "no centre of mass: that of the colliders", str(vec3(center)))
    values, axes = _moments(stage, link, parts, mass, center, moments)
    x, y, z = (plain_float(value) for value in values)
    if max(x, y, z) < SMALLEST:
        tiny = Inertial(plain_float(mass), vec3(center), (x, y, z), axes)
        return _tiny(stage, link, tiny, None if welded else parts or parts_of(stage, link, pieces))
    return Inertial(plain_float(mass), vec3(center), _possible(stage, link, (x, y, z)), axes)


def _tiny(stage: Stage, link: Link, found: Inertial, parts: list[Part] | None) -> Inertial:
    """Return a body whose moments MuJoCo refuses on what moves: as they are without ``parts``, else those of parts."""
    largest = max(found.moments)
    stage.ledger.find("tiny_inertia", link.name, link.path, mass=found.mass, largest=largest)
    if parts is None:
        return replace(found, moments=balanced(found.moments) if largest > 0 else found.moments)
    rule = f"moments below {SMALLEST:g} kg m² on a body that moves: as if they were not given"
    stage.ledger.assume(link.path, rule, f"{largest:g}")
    center = np.array(found.center_of_mass)
    moments, axes = principal(_computed_tensor(stage, link, parts, found.mass, center, True))
    if max(moments) < SMALLEST:
        message = f"principal moments of {found.moments} kg m² are too small"
        raise AssetError(message, key=link.path, expected=f"more than {SMALLEST:g}")
    stage.ledger.warn(f"{link.path}: {rule}; the model has {moments}")
    return replace(found, moments=moments, axes=axes)


def _moments(
    stage: Stage, link: Link, parts: list[Part], mass: float, center: Array, authored: tuple[Vec3, Quat | None] | None
) -> tuple[Vec3, Quat]:
    """Return moments and axes; either, where it is not authored, is that of the colliders, as in PhysX."""
    if authored is not None and authored[1] is not None:
        return authored[0], authored[1]
    if authored is not None and not parts:
        return authored[0], (1.0, 0.0, 0.0, 0.0)
    moments, axes = principal(_computed_tensor(stage, link, parts, mass, center, authored is None))
    if authored is not None:
        if axes != (1.0, 0.0, 0.0, 0.0):
            stage.ledger.assume(link.path, "no principal axes: those of the colliders, as PhysX", str(axes))
        return authored[0], axes
    return moments, _authored_axes(stage, link) or axes


def _authored_mass(stage: Stage, link: Link) -> float | None:
    value = stage.ledger.read(link.prim, "physics:mass")
    if not given(value):
        if value is not None and value < 0:
            stage.ledger.leave(link.path, "physics:mass", "a negative mass is taken for not given", value)
            stage.ledger.warn(f"{link.path}: a mass of {value:g} is taken for not given")
        return None
    stage.ledger.mapped(link.path, "physics:mass", "inertial mass")
    return stage.units.mass(value)


def _computed_mass(stage: Stage, link: Link, parts: list[Part]) -> float:
    total = sum(part.mass for part in parts)
    if total > 0:
        stage.ledger.assume(link.path, "no mass: from the colliders' volume and density", f"{total:.6g} kg")
        if stage.ledger.assumed(link.path, NO_DENSITY):
            stage.ledger.find("no_inertial", link.name, link.path, mass=total)
        return total
    mass = stage.units.mass(BARE_MASS)
    stage.ledger.assume(link.path, "no mass and no collider: as PhysX, one unit of the stage", f"{mass:g} kg")
    stage.ledger.find("no_inertial", link.name, link.path, mass=mass)
    return mass


def _center(stage: Stage, link: Link) -> Array | None:
    """Return the authored centre in the body's frame, stretched by the prim's scale; -inf means not given."""
    value = stage.ledger.read(link.prim, "physics:centerOfMass")
    if value is None or not all(math.isfinite(v) for v in value):
        return None
    stage.ledger.mapped(link.path, "physics:centerOfMass", "inertial pos")
    inside = link.frame.inverse().matrix() @ stage.matrix(link.prim)
    return apply(inside, np.array([value]))[0]


def _authored_moments(stage: Stage, link: Link) -> tuple[Vec3, Quat | None] | None:
    """Return authored principal moments (kg m²) and axes (None: not authored), None when no moments are given."""
    ledger, factor = stage.ledger, stage.units.inertia(1.0)
    six = ledger.read(link.prim, "newton:inertia")
    if six is not None and len(six) == 6 and any(six):
        _newton_wins(stage, link)
        a, b, c, d, e, f = (v * factor for v in six)
        return principal(np.array([[a, d, e], [d, b, f], [e, f, c]]))
    moments = ledger.read(link.prim, "physics:diagonalInertia")
    if not given_moments(moments):
        return None
    ledger.mapped(link.path, "physics:diagonalInertia", "inertial diaginertia")
    if any(v < 0 for v in moments):
        ledger.assume(link.path, "a negative moment of inertia: its size counts", str(moments))
        ledger.warn(f"{link.path}: moments of inertia {moments} are read without their signs")
    x, y, z = (abs(float(v)) * factor for v in moments)
    return (x, y, z), _authored_axes(stage, link)


def _newton_wins(stage: Stage, link: Link) -> None:
    stage.ledger.mapped(link.path, "newton:inertia", "inertial diaginertia and quat")
    for name in ("physics:diagonalInertia", "physics:principalAxes"):
        if (value := stage.ledger.read(link.prim, name)) is not None:
            stage.ledger.leave(link.path, name, "newton:inertia, the full tensor, wins over it", value)


def given_moments(value: Any) -> bool:
    """Return whether authored moments say anything: at least one of them is positive, and all are finite."""
    return value is not None and any(v > 0 for v in value) and all(math.isfinite(v) for v in value)


def _authored_axes(stage: Stage, link: Link) -> Quat | None:
    axes = stage.ledger.read(link.prim, "physics:principalAxes")
    if axes is None or not any(axes):
        return None
    stage.ledger.mapped(link.path, "physics:principalAxes", "inertial quat")
    return quaternion(rotation_matrix(axes))


def _computed_tensor(
    stage: Stage, link: Link, parts: list[Part], mass: float, center: Array, for_moments: bool
) -> Array:
    """Return the colliders' tensor, scaled to the mass, about ``center``."""
    if sum(part.mass for part in parts) <= 0:
        stage.ledger.assume(link.path, "no inertia and no collider: a sphere of 0.1 m, as PhysX", "0.4 m r²")
        stage.ledger.find("no_inertia", link.name, link.path, mass=mass)
        return np.eye(3) * 0.4 * mass * BARE_RADIUS**2
    if for_moments:
        stage.ledger.assume(link.path, "no inertia: from the colliders, scaled to the mass", "principal moments")
        stage.ledger.find("no_inertia", link.name, link.path, mass=mass)
    return combined_tensor(parts, mass, center)


def _possible(stage: Stage, link: Link, moments: Vec3) -> Vec3:
    """Return moments that MuJoCo accepts, and say so when the file's are not."""
    able = balanced(moments)
    if able == moments:
        return moments
    stage.ledger.assume(link.path, "moments that no body can have (A + B < C): the largest is cut", f"{able}")
    a, b, c = moments
    stage.ledger.find("impossible_inertia", link.name, link.path, a=a, b=b, c=c, cut_to=max(able))
    if not np.allclose(able, moments, rtol=0.01, atol=0):
        stage.ledger.warn(f"{link.path}: MuJoCo refuses its principal moments {moments}; {able} stand in the model")
    return able
