"""Mass properties of URDF links.

A link without mass is a frame on the link that it is welded to: ROS uses such links to place shapes and to name frames.
If a moving group of welded links has no mass at all, its mass comes from the volume of its colliders.
"""

from __future__ import annotations

import numpy as np

from wheelleg_exp.asset import rigid_geometry as geometry
from wheelleg_exp.asset.robot_description import BaseMode, Inertial, Vec3
from wheelleg_exp.asset.urdf.urdf_document import Document
from wheelleg_exp.asset.urdf.urdf_tree import Link, Seen, Tree
from wheelleg_exp.asset.usd.bodies.mass import SMALLEST, without_signs
from wheelleg_exp.asset.usd.gprims import Shape, solid_of

NOISE = 1e-6  # A URDF link's inertia counts as missing if its radius of gyration is below 1e-6 m.
TENSOR = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def inertials(
    document: Document, tree: Tree, seen: dict[str, Seen], colliders: dict[str, list[Shape]], base: BaseMode
) -> dict[str, Inertial]:
    """Return each link's mass properties; a moving link without a mass gets the mass of its ``colliders``' volume."""
    links = tree.links.values()
    found = {link.name: _part(document, link, seen[link.name], colliders[link.name]) for link in links}
    # Collect groups of welded links, because MuJoCo needs mass and inertia for only one link of each group.
    groups: dict[str, list[Link]] = {}
    tops: dict[str, str] = {}
    for member in tree.depth_first():
        joint = member.joint
        dropped = base == "floating" and joint is not None and joint.parent is tree.world
        tops[member.name] = tops[joint.parent.name] if joint and joint.welds and not dropped else member.name
        groups.setdefault(tops[member.name], []).append(member)
    for group in groups.values():
        top = group[0]
        moves = top.joint is not None or not (base == "fixed" or top is tree.world)
        unweighed = [link for link in group if not found[link.name].mass]
        if moves and unweighed and not any(_enough(found[link.name]) for link in group):
            # A moving link without mass gets a mass from its colliders' volume or, without colliders, 1 kg as in PhysX.
            heavy = {
                link.name: part for link in unweighed if (part := _by_volume(document, link, colliders[link.name]))
            }
            first = unweighed[0]
            if not heavy:
                heavy = {first.name: _bare(document, first, geometry.BARE_MASS, np.zeros(3))}
            mass = sum(part.mass for part in heavy.values())
            reason = "the link moves, and neither it nor links welded to it have a mass"
            document.ledger.warn(f"{first.element.path}: {reason}; the model's mass is {mass:.6g} kg, as in PhysX")
            found.update(heavy)
        for link in group:
            if link.element.first("inertial") is None or (link in unweighed and found[link.name].mass):
                document.ledger.find("no_inertial", link.name, link.element.path, mass=found[link.name].mass)
        if moves and not any(_enough(found[link.name]) for link in group):
            message = f"the link moves, and its mass or inertia is below {SMALLEST:g}"
            document.fail(top.element, message, "a larger mass and inertia, which MuJoCo needs")
    return {link.name: _inertial(document, link, found[link.name]) for link in links if link is not tree.world}


def _enough(part: geometry.Part) -> bool:
    return part.mass >= SMALLEST and float(np.linalg.eigvalsh(part.tensor)[-1]) >= SMALLEST


def _part(document: Document, link: Link, seen: Seen, colliders: list[Shape]) -> geometry.Part:
    center, tensor = seen.inertia_frame.translation, _tensor(document, link, seen.mass)
    if seen.mass > 0 and tensor is not None:
        turn = seen.inertia_frame.rotation
        return geometry.Part(seen.mass, center, turn @ tensor @ turn.T)
    if seen.mass == 0:
        return geometry.Part(0.0, center, np.zeros((3, 3)))
    parts = _weights(colliders)
    document.ledger.find("no_inertia", link.name, link.element.path, mass=seen.mass, computed=bool(parts))
    if not parts:
        return _bare(document, link, seen.mass, center)
    document.ledger.mapped(link.element.path, "collision", "inertial diaginertia, computed from the shapes")
    return geometry.Part(seen.mass, center, geometry.combined_tensor(parts, seen.mass, center))


def _weights(colliders: list[Shape]) -> list[geometry.Part]:
    solids = [solid for shape in colliders if (solid := solid_of(shape)) is not None]
    return [geometry.Part.of(solid, geometry.WATER * solid.volume) for solid in solids]


def _by_volume(document: Document, link: Link, colliders: list[Shape]) -> geometry.Part | None:
    parts = _weights(colliders)
    if not parts:
        return None
    mass, middle = sum(part.mass for part in parts), geometry.combined_center(parts)
    rule = f"no mass: the colliders' volume, {geometry.WATER:g} kg/m³"
    document.ledger.assume(link.element.path, rule, f"{mass:.6g} kg")
    return geometry.Part(mass, middle, geometry.combined_tensor(parts, mass, middle))


def _tensor(document: Document, link: Link, mass: float) -> geometry.Array | None:
    """Return a link's inertia tensor in its ``<inertial>`` frame; None if the tensor is missing or almost zero."""
    element = link.element.first("inertial", "inertia")
    if element is None:
        return None
    became = "inertial diaginertia and quat" if mass else None
    values = [document.number(element, name, became) or 0.0 for name in TENSOR]
    a, b, c, d, e, f = values
    tensor = np.array([[a, d, e], [d, b, f], [e, f, c]])
    if not any(values) or not mass:
        return None
    moments, axes = geometry.principal(tensor)
    if min(moments) < 0:
        moments = without_signs(document.ledger, link.element.path, moments)
        tensor = geometry.tensor_of(moments, axes)
    if max(moments) > mass * NOISE**2:
        return tensor
    document.ledger.leave(element.path, "inertia", "zero but for rounding, which means not given", _listed(moments))
    document.ledger.find("tiny_inertia", link.name, link.element.path, mass=mass, largest=max(moments))
    return None


def _bare(document: Document, link: Link, mass: float, center: geometry.Array) -> geometry.Part:
    rule = "no inertia and no collider: a sphere of 0.1 m, as PhysX"
    document.ledger.assume(link.element.path, rule, f"{mass:g} kg")
    return geometry.Part(mass, center, np.eye(3) * 0.4 * mass * geometry.BARE_RADIUS**2)


def _inertial(document: Document, link: Link, part: geometry.Part) -> Inertial:
    x, y, z = (float(value) + 0.0 for value in part.center)
    if part.mass == 0:
        document.ledger.assume(link.element.path, "no mass: a frame on its parent", "0 kg")
        return Inertial(0.0, (x, y, z), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    moments, axes = geometry.principal(part.tensor)
    path, shown = link.element.path, _listed(moments)
    able = geometry.balanced(moments)
    if able != moments:
        a, b, c = moments
        document.ledger.find("impossible_inertia", link.name, path, a=a, b=b, c=c, cut_to=max(able))
        rule = "physically impossible moments (A + B < C): the largest is reduced"
        document.ledger.assume(path, rule, f"{shown} to {_listed(able)} kg m²")
        if not np.allclose(able, moments, rtol=0.01, atol=0):
            document.ledger.warn(f"{path}: no body has the moments of inertia {shown}; the model has {_listed(able)}")
    return Inertial(part.mass, (x, y, z), able, axes)


def _listed(moments: Vec3) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in moments) + ")"
