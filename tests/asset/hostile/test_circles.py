"""USD files can refer to each other in a cycle: a conversion breaks the cycle and reads the robot."""

from pathlib import Path

import pytest

from .. import small_urdf, small_usd
from ..small_usd import SI, applied, link
from .scratch import Maker, Scratch, urdf

BALL = f'def Sphere "ball" {applied("PhysicsCollisionAPI MaterialBindingAPI")}\n{{\n%s\n}}\n'


def usd(inside: str, *, outside: str = "", header: str = SI) -> Maker:
    return lambda folder: small_usd.write(folder, link("a", inside=BALL % "") + inside, outside=outside, header=header)


def prim(name: str, metadata: str, inside: str = "", kind: str = "Xform") -> str:
    return f'def {kind} "{name}" ({metadata})\n{{\n{inside}\n}}\n'


def joint(body0: str, body1: str) -> str:
    return f'def PhysicsRevoluteJoint "j"\n{{\nrel physics:body0 = {body0}\nrel physics:body1 = {body1}\n}}\n'


def mutual(folder: Path) -> Path:
    other = prim("other", "references = @./bot.usda@")
    (folder / "other.usda").write_text(f'#usda 1.0\n(\n    defaultPrim = "other"\n)\n{other}')
    return usd(prim("x", "references = @./other.usda@"))(folder)


def package_of_itself(folder: Path) -> Path:
    path = usd(prim("x", "references = @./bot.usdz@"))(folder)
    (folder / "bot.usdz").symlink_to("bot.usdz")
    return path


METAL = prim("m", "references = </bot/n>", "token outputs:surface.connect = </bot/m.outputs:surface>", "Material")
MATERIALS = METAL + prim("n", "references = </bot/m>", kind="Material")
FOLLOWERS = "".join(small_urdf.link(name) for name in "abc")
FOLLOWERS += small_urdf.joint("j", "a", "b", "continuous", '<mimic joint="k"/>')
FOLLOWERS += small_urdf.joint("k", "b", "c", "continuous", '<mimic joint="j"/>')

CIRCLES: dict[str, Maker] = {
    "a class of itself": usd(prim("x", "inherits = </bot/x>")),
    "a payload of its own file": usd(prim("x", "payload = @./bot.usda@")),
    "an instance of what holds it": usd(prim("x", "instanceable = true\nreferences = </bot>")),
    "files that refer to each other": mutual,
    "a package that is a link to itself": package_of_itself,
    "a layer below itself": usd("", header=SI + "\n    subLayers = [@./bot.usda@]"),
    "prims that swap places": usd("", header=SI + "\n    relocates = { </bot/a>: </bot/b>, </bot/b>: </bot/a> }"),
    "materials of each other": usd(MATERIALS),
    "an attribute of itself": usd('def "x"\n{\nfloat inputs:a.connect = </bot/x.inputs:a>\n}\n'),
    "a joint whose ends are each other": usd(joint("</bot/j.physics:body1>", "</bot/j.physics:body0>")),
    "a joint to an attribute": usd(joint("</bot/a.physics:mass>", "</bot/a>")),
    "joints that follow each other": urdf(FOLLOWERS),
    "a joint that follows itself": urdf(small_urdf.pair("continuous", '<mimic joint="j"/>')),
}


@pytest.mark.parametrize("name", CIRCLES)
def test_a_circle_is_cut_and_the_robot_read(scratch: Scratch, name: str) -> None:
    said = scratch.convert(CIRCLES[name])
    assert said.status == 0, said.err
    assert "bodies              " in said.out
