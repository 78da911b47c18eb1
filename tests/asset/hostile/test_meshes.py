"""For a damaged mesh file, the conversion omits the shape with the reason, and converts the remaining robot."""

import struct
from pathlib import Path

import mujoco
import pytest

from wheelleg_exp.asset import convert_robot, file_limits
from wheelleg_exp.asset.urdf import mesh_files

from .. import small_urdf
from .scratch import CANARY, Scratch

NAN, INFINITE = float("nan"), float("inf")


def stl(claim: int, *corners: float) -> bytes:
    faces = [struct.pack("<12fH", 0, 0, 1, 0, 0, 0, *corners, 0)] if corners else []
    return bytes(80) + struct.pack("<I", claim) + b"".join(faces)


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
POLYGONS = '<triangles><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 1 3</p></triangles>'
MESH = f"""<source id="p"><float_array count="12">0 0 0 1 0 0 0 1 0 0 0 1</float_array>
<technique_common><accessor stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
{POLYGONS}"""
SHOWN = '<visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>'


def dae(old: str = "", new: str = "", *, scene: str = SHOWN, before: str = "", nodes: str = "") -> str:
    assert old in MESH
    return (
        f"{before}<COLLADA><library_geometries><geometry id='g'><extra/><mesh>{MESH.replace(old, new) if old else MESH}"
        f"</mesh></geometry></library_geometries><library_nodes>{nodes}</library_nodes>"
        f"<library_visual_scenes>{scene}</library_visual_scenes>"
        "<scene><instance_visual_scene url='#s'/></scene></COLLADA>"
    )


def node(inside: str) -> str:
    return f'<visual_scene id="s"><node>{inside}</node></visual_scene>'


def floors(last: str) -> str:
    steps = [f'<instance_node url="#n{i + 1}"/>' for i in range(40)]
    nodes = "".join(f'<node id="n{i}">{step * 10}</node>' for i, step in enumerate(steps))
    return f'{nodes}<node id="n40">{last}</node>'


def polygons(counts: str) -> str:
    return dae(POLYGONS, POLYGONS.replace("triangles", "polylist").replace("<p>", f"<vcount>{counts}</vcount><p>"))


SECRET = '<!DOCTYPE c [<!ENTITY x SYSTEM "../canary">]>'
TOO_MANY = "has more than 1,000 points and triangles"
INSTANCE = '<instance_geometry url="#g"/>'
RING = dae(scene=node('<instance_node url="#n"/>'), nodes='<node id="n"><instance_node url="#n"/></node>')
TOWER = dae(scene=node('<instance_node url="#n0"/>'), nodes=floors(INSTANCE))
NAN_MATRIX = dae(scene=node(f"<matrix>{'nan ' * 16}</matrix><instance_geometry url='#g'/>"))
DAMAGED: dict[str, tuple[str | bytes, str]] = {  # content, reason
    "STL of four thousand million faces": (stl(2**32 - 1, 1, 0, 0, 0, 1, 0), "does not match its number of triangles"),
    "STL with NaN": (stl(1, NAN, 0, 0, 0, 1, 0), "not finite"),
    "STL cut short": (stl(1, 1, 0, 0, 0, 1, 0)[:-7], "does not match its number of triangles"),
    "STL of words": ("solid\nvertex a b c\nvertex 0 0 0\nvertex 1 1 1", "could not convert"),
    "OBJ with an index of 24 digits": (POINTS + "f 1 2 " + "9" * 24, "damaged"),
    "OBJ with an index before the first": (POINTS + "f -1 -2 -99", "no triangles"),
    "OBJ with points of two numbers": ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "damaged"),
    "OBJ with NaN": (POINTS.replace("1 0 0", "nan 1e999 0") + "f 1 2 3", "not finite"),
    "OBJ with too many points": (POINTS * 300 + "f 1 2 3\nf 1 2 4\n", f"the mesh file {TOO_MANY}"),
    "COLLADA of a secret": (dae("0 0 0 1", "&x;", before=SECRET), "document type"),
    "COLLADA with a stride of zero": (dae('stride="3"', 'stride="0"'), "without positions"),
    "COLLADA with an index before the first": (dae("0 1 2 0 1 3", "0 1 -1"), "no triangles"),
    "COLLADA without positions": (dae("POSITION", "NORMAL"), "without positions"),
    "COLLADA with positions elsewhere": (dae("#p", "http://127.0.0.1/x#p"), "refers to 'http://127.0.0.1/x#p'"),
    "COLLADA of polygons of 2e9 corners": (polygons("2000000000 2000000000"), "do not match"),
    "COLLADA in a ring": (RING, "in a cycle, or describe"),
    "COLLADA that multiplies": (TOWER, "in a cycle, or describe"),
    "COLLADA of equal shapes": (dae(scene=node(INSTANCE * 200)), TOO_MANY.removeprefix("has ")),
    "COLLADA with a matrix of NaN": (NAN_MATRIX, "not finite"),
    "COLLADA that is deep": ("<COLLADA>" + "<node>" * 100_000, "levels deep"),
    "COLLADA that is something else": (CANARY, "not valid XML"),
}
WHOLE: dict[str, str | bytes] = {
    "STL with more than it says": stl(1, 1, 0, 0, 0, 1, 1) + bytes(99),
    "OBJ with files of its own": f"mtllib ../canary\ncall ../canary\n{POINTS}f 1 2 3\nf 1 2 4",
    "COLLADA that says it has more": dae('count="12"', 'count="1000000000000"'),
    "COLLADA in UTF-16": dae().encode("utf-16"),
    "COLLADA without a scene": dae().replace("instance_visual_scene", "extra"),
}
ENDINGS = {"STL": "m.stl", "OBJ": "m.obj", "COLLADA": "m.dae"}


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_files, "MOST_POINTS", 1_000)
    monkeypatch.setattr(mesh_files, "MOST_PARTS", 10_000)


def robot(folder: Path, name: str, content: str | bytes) -> Path:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    shape = f'<geometry><mesh filename="{name}"/></geometry>'
    inside = f"<visual>{shape}</visual><collision>{shape}</collision>{small_urdf.BOX}"
    return small_urdf.write(folder, small_urdf.link("a", inside))


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_mesh_is_left_out_with_the_reason(scratch: Scratch, few: None, name: str) -> None:
    content, reason = DAMAGED[name]
    said = scratch.convert(lambda folder: robot(folder, ENDINGS[name.split()[0]], content))
    assert said.status == 0, said.err
    assert "warning: /robot/link[a]/collision[1]: a collider was left out: mesh" in " ".join(said.out.split())
    assert reason in " ".join(said.out.split())
    assert mujoco.MjModel.from_xml_path(str(scratch.out / "bot.xml")).ngeom == 1


@pytest.mark.parametrize("name", WHOLE)
def test_a_mesh_that_is_only_odd_is_read(scratch: Scratch, name: str) -> None:
    said = scratch.convert(lambda folder: robot(folder, ENDINGS[name.split()[0]], WHOLE[name]))
    assert said.status == 0, said.err
    assert mujoco.MjModel.from_xml_path(str(scratch.out / "bot.xml")).ngeom == 3


def test_the_largest_meshes_fit_the_memory_that_a_conversion_may_take() -> None:
    assert file_limits.MOST_POINTS * file_limits.POINT_BYTES <= file_limits.MOST


def test_meshes_that_take_much_memory_are_reported_and_too_large_ones_refused(scratch, monkeypatch):
    monkeypatch.setattr(convert_robot, "POINT_BYTES", 10**9)
    monkeypatch.setattr(convert_robot, "machine_memory", lambda: 13 * 10**9)
    mesh = small_urdf.TETRAHEDRON
    said = scratch.convert(lambda folder: robot(folder, "m.obj", mesh))
    assert "warning: meshes with 12 points and triangles take about 12 GB of memory" in " ".join(said.out.split())
    monkeypatch.setattr(convert_robot, "machine_memory", lambda: 11 * 10**9)
    said = scratch.convert(lambda folder: robot(folder, "m.obj", mesh))
    assert said.status == 2
    assert "take about 12 GB of memory" in said.err
    assert "expected less than the 11 GB of this machine" in said.err
