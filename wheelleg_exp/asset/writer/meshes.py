"""Writes meshes as OBJ files."""

from __future__ import annotations

import re

from wheelleg_exp.asset.description import Mesh


def file_name(mesh: Mesh) -> str:
    """Return the mesh's file name: its own, without what file systems take for folders."""
    return re.sub(r"[^\w.-]", "_", mesh.name) + ".obj"


def obj_text(mesh: Mesh) -> str:
    """Return the mesh as OBJ, every number without loss."""
    points = ["v %r %r %r" % (x, y, z) for x, y, z in mesh.vertices.tolist()]  # noqa: UP031 (twice as fast)
    faces = ["f %d %d %d" % (a, b, c) for a, b, c in (mesh.faces + 1).tolist()]  # noqa: UP031
    return "\n".join([*points, *faces]) + "\n"
