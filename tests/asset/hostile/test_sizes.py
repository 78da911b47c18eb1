"""Small files that describe too many or too distant parts: an error before time and memory run out."""

from __future__ import annotations

from pathlib import Path

import pytest

from .. import small_urdf, small_usd
from ..small_usd import cube_inside, hinge, link
from .scratch import Maker, Scratch

BALL = '<visual><geometry><sphere radius="1"/></geometry></visual>'
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"


def usd(inside: str, outside: str = "") -> Maker:
    return lambda folder: small_usd.write(folder, link("a") + inside, outside=outside)


def urdf(inside: str) -> Maker:
    return lambda folder: small_urdf.write(folder, inside)


def prim(name: str, metadata: str = "", inside: str = "") -> str:
    return f'def "{name}" ({metadata})\n{{\n{inside}\n}}\n'


# ---------------------------------------------------------------- what is many
def with_mesh(inside: str) -> Maker:
    def make(folder: Path) -> Path:
        (folder / "part.obj").write_text(TETRAHEDRON)
        return small_urdf.write(folder, inside)

    return make


def scaled(count: int) -> str:
    return "".join(
        f'<visual><geometry><mesh filename="part.obj" scale="1 1 {i + 1}"/></geometry></visual>' for i in range(count)
    )


READER = "wheelleg_exp.asset"
MANY: dict[str, tuple[str, int, Maker, str]] = {  # limit, its value, robot, message
    "prims": (
        f"{READER}.usd.usd_stage.MOST_PRIMS",
        20,
        usd("".join(prim(f"x{i}") for i in range(30))),
        "20 prims below /bot",
    ),
    "bodies": (
        f"{READER}.usd.bodies.rigid_bodies.MOST_BODIES",
        5,
        usd("".join(link(f"x{i}") for i in range(9))),
        "5 rigid bodies",
    ),
    "shapes": (
        f"{READER}.usd.colliders.MOST_SHAPES",
        5,
        usd("".join(f'def Sphere "s{i}"\n{{\n}}\n' for i in range(9))),
        "5 shapes",
    ),
    "points of instances": (
        f"{READER}.usd.colliders.MOST_POINTS",
        30,
        usd(
            "".join(prim(f"x{i}", "instanceable = true\nreferences = </proto>") for i in range(4)),
            f'def Xform "proto"\n{{\n{cube_inside("none")}\n}}\n',
        ),
        "30 points and triangles",
    ),
    "elements of XML": (
        f"{READER}.urdf.urdf_document.MOST_ELEMENTS",
        20,
        urdf(small_urdf.link("a") + "<x/>" * 30),
        "20 elements",
    ),
    "links": (
        f"{READER}.urdf.urdf_tree.MOST_BODIES",
        5,
        urdf(
            "".join(small_urdf.link(f"l{i}") + small_urdf.joint(f"j{i}", "r", f"l{i}", "fixed") for i in range(9))
            + small_urdf.link("r")
        ),
        "5 links",
    ),
    "shapes of links": (f"{READER}.urdf.urdf_shapes.MOST_SHAPES", 5, urdf(small_urdf.link("a", BALL * 9)), "5 shapes"),
    "points of one mesh, scaled": (
        f"{READER}.urdf.urdf_shapes.MOST_POINTS",
        30,
        with_mesh(small_urdf.link("a", scaled(9))),
        "30 points and triangles",
    ),
}


@pytest.mark.parametrize("name", MANY)
def test_what_is_too_many_is_told(scratch: Scratch, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    bound, most, make, words = MANY[name]
    assert scratch.convert(make, "--json").status == 0
    monkeypatch.setattr(bound, most)
    said = scratch.convert(make)
    assert said.status == 2
    assert words in said.err


# ---------------------------------------------------------------- what is far
MOVED = (
    "float physics:mass = 1\nfloat3 physics:diagonalInertia = (1, 1, 1)\npoint3f physics:centerOfMass = (1e10, 0, 0)"
)
FAR: dict[str, tuple[Maker, str]] = {
    "joint of a USD": (
        usd(link("b") + hinge("j", "a", "b", text="point3f physics:localPos0 = (0, 1e10, 0)")),
        "/bot/b",
    ),
    "centre of mass of a USD": (usd(link("b", mass=MOVED)), "/bot/b"),
    "joint of a URDF": (urdf(small_urdf.pair("fixed", '<origin xyz="1e10 0 0"/>')), "/robot/link[b]"),
    "centre of mass of a URDF": (
        urdf(small_urdf.link("a", inertial=small_urdf.inertial(1, at="0 0 1e10", tensor="1 1 1 0 0 0"))),
        "/robot/link[a]",
    ),
    "shape of a URDF": (
        urdf(small_urdf.link("a", BALL.replace("<geometry", '<origin xyz="0 -1e10 0"/><geometry'))),
        "visual",
    ),
    "size of a URDF's shape": (urdf(small_urdf.link("a", BALL.replace('"1"', '"1e29"'))), "/robot/link[a]/visual"),
    "mesh of a URDF": (with_mesh(small_urdf.link("a", scaled(1).replace("1 1 1", "1e30 1 1"))), "/geometry/mesh"),
}


@pytest.mark.parametrize("name", FAR)
def test_what_no_robot_reaches_is_told(scratch: Scratch, name: str) -> None:
    make, key = FAR[name]
    said = scratch.convert(make)
    assert said.status == 2
    assert f"{key}: the position or size reaches 1e+" in said.err
    assert "expected less than 1e+09 m" in said.err
