"""Writes meshes as OBJ files."""

from __future__ import annotations

import re

from wheelleg_exp.asset.description import Mesh
from wheelleg_exp.asset.writer.xml import number


def file_name(mesh: Mesh) -> str:
    """Return the mesh's file name: its own, without what file systems take for folders."""
    return re.sub(r"[^\w.-]", "_", mesh.name) + ".obj"


def obj_text(mesh: Mesh) -> str:
    """Return the mesh as OBJ, every number without loss."""
    points = (f"v {number(float(x))} {number(float(y))} {number(float(z))}" for x, y, z in mesh.vertices)
    faces = (f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces)
    return "\n".join([*points, *faces]) + "\n"
