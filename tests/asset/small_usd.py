"""Small USD files, written by hand, and the MuJoCo models of the converted robots."""

import math
from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.asset import Conversion, convert
from wheelleg_exp.asset.report_writer import FALLS

AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
DEGREES = 180 / math.pi
SI = 'defaultPrim = "bot"\n    metersPerUnit = 1\n    upAxis = "Z"'

LINK = """
    def Xform "{name}" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"{apis}]
    )
    {{
        double3 xformOp:translate = {at}
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {mass}
        {inside}
    }}
"""

MASS = """float physics:mass = 1
        float3 physics:diagonalInertia = (0.1, 0.1, 0.1)
        point3f physics:centerOfMass = (0, 0, 0)"""


def applied(apis: str) -> str:
    schemas = ", ".join(f'"{api}"' for api in apis.split())
    return f"(\n        prepend apiSchemas = [{schemas}]\n    )" if schemas else ""


def link(name: str, at: str = "(0, 0, 0)", *, mass: str = MASS, inside: str = "", apis: str = "") -> str:
    extra = "".join(f', "{api}"' for api in apis.split())
    return LINK.format(name=name, at=at, mass=mass, inside=inside, apis=extra)


def hinge(name: str, parent: str, child: str, *, kind: str = "Revolute", apis: str = "", text: str = "") -> str:
    return f"""
    def Physics{kind}Joint "{name}" {applied(apis)}
    {{
        rel physics:body0 = </bot/{parent}>
        rel physics:body1 = </bot/{child}>
        {text}
    }}
"""


def write(folder: Path, inside: str, *, header: str = SI, outside: str = "", root_apis: str = "") -> Path:
    path = folder / "bot.usda"
    path.write_text(
        f'#usda 1.0\n(\n    {header}\n)\n\ndef Xform "bot" {applied(root_apis)}\n{{\n{inside}\n}}\n{outside}\n'
    )
    return path


def converted(path: Path, **options: object) -> tuple[mujoco.MjModel, Conversion]:
    done = convert(path, path.parent / "out" / "bot.xml", **options)
    return mujoco.MjModel.from_xml_path(str(done.output)), done


def warned(conversion: Conversion) -> tuple[str, ...]:
    """Return the warnings; most of the small robots have no colliders."""
    return tuple(text for text in conversion.report.warnings if text != FALLS)


def two_links(folder: Path, joint_text: str = "", *, apis: str = "", kind: str = "Revolute", **options: object):
    text = f"point3f physics:localPos0 = (1, 0, 0)\n        {joint_text}"
    body = link("a") + link("b", "(1, 0, 0)") + hinge("j", "a", "b", apis=apis, kind=kind, text=text)
    return converted(write(folder, body), **options)


def limits(**ranges: tuple[float | str, float]) -> str:
    return "\n".join(
        f"float limit:{axis}:physics:low = {low}\n float limit:{axis}:physics:high = {high}"
        for axis, (low, high) in ranges.items()
    )


def locked(*axes: str) -> str:
    return limits(**dict.fromkeys(axes, (1, -1)))


def tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Return a body's inertia tensor about its centre of mass, in the body's axes."""
    item, turn = model.body(body), np.zeros(9)
    mujoco.mju_quat2Mat(turn, item.iquat)
    return turn.reshape(3, 3) @ np.diag(item.inertia) @ turn.reshape(3, 3).T


def cube_inside(approximation: str) -> str:
    corners = [(x, y, z) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)]
    return f"""def Mesh "block" (
            prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]
        )
        {{
            point3f[] points = {corners}
            int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
            int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
            uniform token physics:approximation = "{approximation}"
        }}"""
