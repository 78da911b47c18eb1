"""Write the URDF of an MJCF robot with hinges and primitive colliders, which ``wheelleg import`` cannot read.

python docs/arena/urdf_of_mjcf.py ROBOT.xml ROBOT.urdf
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import mujoco
import numpy as np

SHAPES: dict[int, tuple[str, Callable[[Any], dict[str, str]]]] = {  # dimensions of MuJoCo's half sizes
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", lambda s: {"size": f"{2 * s[0]} {2 * s[1]} {2 * s[2]}"}),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", lambda s: {"radius": f"{s[0]}", "length": f"{2 * s[1]}"}),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", lambda s: {"radius": f"{s[0]}"}),
}


def add_origin(parent: Xml.Element, pos: np.ndarray, quat: np.ndarray) -> None:
    """Add position and rotation (w, x, y, z) as URDF's fixed angles."""
    r = np.zeros(9)
    mujoco.mju_quat2Mat(r, quat)
    angles = np.arctan2(r[7], r[8]), -np.arcsin(np.clip(r[6], -1, 1)), np.arctan2(r[3], r[0])
    Xml.SubElement(
        parent, "origin", xyz=" ".join(map(repr, map(float, pos))), rpy=" ".join(map(repr, map(float, angles)))
    )


def urdf(model: mujoco.MjModel) -> Xml.Element:
    """Return the robot of a model; its first body has the free joint."""
    robot = Xml.Element("robot", name="robot")
    limits = {model.actuator_trnid[i, 0]: model.actuator_forcerange[i, 1] for i in range(model.nu)}
    for index in range(1, model.nbody):
        body = model.body(index)
        link = Xml.SubElement(robot, "link", name=body.name)
        inertial = Xml.SubElement(link, "inertial")
        add_origin(inertial, body.ipos, body.iquat)
        Xml.SubElement(inertial, "mass", value=repr(float(body.mass[0])))
        moments = {f"i{axis}{axis}": repr(float(value)) for axis, value in zip("xyz", body.inertia, strict=True)}
        Xml.SubElement(inertial, "inertia", {"ixy": "0", "ixz": "0", "iyz": "0", **moments})
        for number in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            geom = model.geom(number)
            if geom.contype[0]:
                for use in ("visual", "collision"):
                    shape = Xml.SubElement(link, use)
                    add_origin(shape, geom.pos, geom.quat)
                    name, sizes = SHAPES[int(geom.type[0])]
                    Xml.SubElement(Xml.SubElement(shape, "geometry"), name, sizes(geom.size))
        if body.parentid[0]:
            hinge = model.joint(body.jntadr[0])
            kind = "revolute" if model.jnt_limited[hinge.id] else "continuous"
            joint = Xml.SubElement(robot, "joint", name=hinge.name, type=kind)
            Xml.SubElement(joint, "parent", link=model.body(body.parentid[0]).name)
            Xml.SubElement(joint, "child", link=body.name)
            add_origin(joint, body.pos, body.quat)
            Xml.SubElement(joint, "axis", xyz=" ".join(map(str, hinge.axis)))
            low, high = map(str, hinge.range)
            Xml.SubElement(joint, "limit", lower=low, upper=high, effort=str(limits[hinge.id]), velocity="1000")
    return robot


if __name__ == "__main__":
    tree = urdf(mujoco.MjModel.from_xml_path(sys.argv[1]))
    Path(sys.argv[2]).write_bytes(Xml.tostring(tree))
