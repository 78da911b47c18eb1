"""Visuals and colliders of URDFs: primitives, mesh files of each format, the mesh file search, and missing files."""

import math
import struct

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset import convert, source_digest

from ..small_urdf import at_zero, left, link, made, write
from ..small_usd import warned

# The tetrahedron with the corners 0, x, y, z has the volume 1/6, and its faces point outwards.
CORNERS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def obj() -> str:
    points = "".join(f"v {x} {y} {z} 0.5 0.5 0.5\n" for x, y, z in CORNERS)
    faces = "".join(f"f {a + 1}/1/1 {b + 1}//2 {c + 1}\n" for a, b, c in FACES[:3]) + "f -3 -2 -1\n"
    return f"# made by hand\nmtllib none.mtl\no part\n{points}vn 0 0 1\nvt 0 0\ns off\n{faces}"


def stl() -> bytes:
    faces = [struct.pack("<12fH", 0, 0, 0, *(v for corner in face for v in CORNERS[corner]), 0) for face in FACES]
    return b"solid but binary".ljust(80) + struct.pack("<I", len(faces)) + b"".join(faces)


def stl_text() -> bytes:
    text = "solid part\n"
    for face in FACES:
        corners = "".join("vertex {} {} {}\n".format(*CORNERS[corner]) for corner in face)
        text += f"facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n"
    return f"{text}endsolid part\n".encode()


def dae(kind: str = "triangles", node: str = "", unit: str = "1") -> str:
    numbers = " ".join(str(v) for corner in CORNERS for v in corner)
    flat = " ".join(f"{corner} 0" for face in FACES for corner in face)
    counts = "<vcount>3 3 3 3</vcount>" if kind == "polylist" else ""
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="some" meter="{unit}"/><up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="pa" count="12">{numbers}</float_array>
      <technique_common><accessor source="#pa" count="4" stride="3"/></technique_common></source>
    <source id="n"><float_array id="na" count="3">0 0 1</float_array></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <{kind} count="4"><input semantic="VERTEX" source="#v" offset="0"/>
      <input semantic="NORMAL" source="#n" offset="1"/>{counts}<p>{flat}</p></{kind}>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s">
    <node id="outer">{node}<node id="inner"><instance_geometry url="#g"/></node></node>
  </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""


def mesh(file: str, kind: str = "visual", scale: str = "1 1 1", origin: str = "") -> str:
    return f'<{kind}>{origin}<geometry><mesh filename="{file}" scale="{scale}"/></geometry></{kind}>'


def hull_volume(description_mesh) -> float:
    a, b, c = (description_mesh.vertices[description_mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


# ---------------------------------------------------------------- primitives
def test_primitives_have_the_size_and_pose_of_the_file(tmp_path):
    at = '<origin xyz="1 2 3" rpy="0 0 0.5"/>'
    shapes = {
        "box": ('<box size="0.2 0.4 0.6"/>', (0.1, 0.2, 0.3), mujoco.mjtGeom.mjGEOM_BOX),
        "sphere": ('<sphere radius="0.5"/>', (0.5,), mujoco.mjtGeom.mjGEOM_SPHERE),
        "cylinder": ('<cylinder radius="0.1" length="0.8"/>', (0.1, 0.4), mujoco.mjtGeom.mjGEOM_CYLINDER),
        "capsule": ('<capsule radius="0.1" length="0.8"/>', (0.1, 0.4), mujoco.mjtGeom.mjGEOM_CAPSULE),
    }
    inside = "".join(f'<collision name="{n}">{at}<geometry>{s[0]}</geometry></collision>' for n, s in shapes.items())
    model, conversion = made(tmp_path, link("a", inside))
    for name, (_, size, kind) in shapes.items():
        geom = model.geom(f"a_{name}")
        assert geom.type[0] == int(kind)
        np.testing.assert_allclose(geom.size[: len(size)], size)
        np.testing.assert_allclose(geom.pos, [1, 2, 3])
        np.testing.assert_allclose(geom.quat, [math.cos(0.25), 0, 0, math.sin(0.25)])
    assert conversion.description.bodies[0].geoms[0].path == "/robot/link[a]/collision[box]"


def test_visuals_are_drawn_and_colliders_touch(tmp_path):
    box = '<geometry><box size="1 1 1"/></geometry>'
    collider = f"<collision>{box}</collision>"
    model, _ = made(tmp_path, link("a", f"<visual>{box}</visual>{collider}{collider}"))
    names = ("a_visual", "a_collision", "a_collision_2")
    assert [(int(model.geom(n).group[0]), int(model.geom(n).contype[0])) for n in names] == [(2, 0), (3, 1), (3, 1)]


def test_shapes_without_size_are_left_out_and_a_lost_collider_is_a_warning(tmp_path):
    flat, odd = '<geometry><box size="0 0 0"/></geometry>', "<geometry><heightmap/></geometry>"
    _, conversion = made(tmp_path, link("a", f"<visual>{flat}</visual><collision>{odd}</collision>"))
    assert left(conversion)["/robot/link[a]/visual visual"] == "its size is zero"
    (warning,) = warned(conversion)
    assert warning == "/robot/link[a]/collision: a collider was left out: a shape of kind 'heightmap' is not supported"


def test_colours_come_from_the_shape_else_from_the_material_of_that_name(tmp_path):
    box = "<geometry><box size='1 1 1'/></geometry>"
    looks = (
        '<material name="red"/>',
        '<material name="red"><color rgba="0.5 0 0 1"/></material>',
        '<material name=""><color rgba="0 0 1 0.5"/></material>',
        '<material name="unknown"/>',
    )
    shapes = "".join(f"<visual>{box}{look}</visual>" for look in looks)
    _, conversion = made(tmp_path, '<material name="red"><color rgba="1 0 0 1"/></material>' + link("a", shapes))
    colours = {item.name: item.rgba for item in conversion.description.materials}
    assert colours == {"red": (1, 0, 0, 1), "red_2": (0.5, 0, 0, 1)}
    found = [(geom.material, geom.rgba) for geom in conversion.description.bodies[0].geoms]
    assert found == [("red", None), ("red_2", None), (None, (0, 0, 1, 0.5)), (None, None)]
    assert left(conversion)["/robot/link[a]/visual[4]/material[unknown] name"] == "a material without colour"


def test_an_invalid_colour_is_left_out_and_the_robot_is_converted(tmp_path):
    look = '<material name="odd"><color rgba="1 0 red"/></material>'
    _, conversion = made(tmp_path, link("a", f'<visual><geometry><sphere radius="1"/></geometry>{look}</visual>'))
    assert conversion.report.totals["visuals"] == 1
    assert left(conversion)["/robot/link[a]/visual/material[odd] color"] == "a colour is four numbers"


# ---------------------------------------------------------------- formats
@pytest.mark.parametrize(
    ("file", "data"),
    [
        ("part.obj", obj().encode()),
        ("part.stl", stl()),
        ("PART.STL", stl_text()),
        ("part.dae", dae().encode()),
        ("polygons.dae", dae("polylist").encode()),
    ],
)
def test_meshes_of_each_format_are_read_completely(tmp_path, file, data):
    (tmp_path / file).write_bytes(data)
    at = '<origin xyz="0 0 5" rpy="0 0 1.5707963267948966"/>'
    model, conversion = made(tmp_path, link("a", mesh(file, origin=at) + mesh(file, "collision", origin=at)))
    for item in conversion.description.meshes:
        assert (len(item.vertices), hull_volume(item)) == (4, pytest.approx(1 / 6))
    data = at_zero(model)
    for index in range(model.ngeom):  # MuJoCo moves a mesh into its inertial frame
        start, count = model.mesh_vertadr[model.geom_dataid[index]], model.mesh_vertnum[model.geom_dataid[index]]
        turn = data.geom_xmat[index].reshape(3, 3)
        corners = model.mesh_vert[start : start + count] @ turn.T + data.geom_xpos[index]
        for x, y, z in CORNERS:
            assert np.abs(corners - (-y, x, z + 5)).max(axis=1).min() < 1e-6


def test_a_mirrored_mesh_is_not_turned_inside_out(tmp_path):
    (tmp_path / "part.stl").write_bytes(stl())
    _, conversion = made(tmp_path, link("a", mesh("part.stl", scale="2 3 -1")))
    (item,) = conversion.description.meshes
    np.testing.assert_allclose(np.ptp(item.vertices, axis=0), [2, 3, 1])
    assert (item.vertices[:, 2].min(), hull_volume(item)) == (-1, pytest.approx(1))


def test_collada_is_placed_by_its_nodes_in_its_unit_and_up_axis_is_ignored_as_in_rviz(tmp_path):
    node = "<translate>10 0 0</translate><rotate>0 0 1 90</rotate><scale>2 1 1</scale>"
    (tmp_path / "part.dae").write_text(dae(node=node, unit="0.01"))
    _, conversion = made(tmp_path, link("a", mesh("part.dae")))
    (item,) = conversion.description.meshes
    # The mesh in centimetres is scaled along x, rotated from x to y, and moved.
    np.testing.assert_allclose(item.vertices, [[0.1, 0, 0], [0.1, 0.02, 0], [0.09, 0, 0], [0.1, 0, 0.01]], atol=1e-12)


def test_equal_meshes_are_written_once_and_scaled_ones_apart(tmp_path):
    (tmp_path / "part.obj").write_text(obj())
    inside = mesh("part.obj") + mesh("part.obj") + mesh("part.obj", scale="2 2 2") + mesh("part.obj", "collision")
    _, conversion = made(tmp_path, link("a", inside))
    assert [item.name for item in conversion.description.meshes] == ["part_visual", "part_visual_2", "part"]
    files = sorted(path.name for path in (tmp_path / "out_meshes").iterdir())
    assert files == ["part.obj", "part_visual.obj", "part_visual_2.obj"]


def test_a_flat_visual_stays_and_a_flat_collider_becomes_a_thin_box(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 2 0\nv 0 2 0\nf 1 2 3 4\n")
    model, conversion = made(tmp_path, link("a", mesh("flat.obj") + mesh("flat.obj", "collision")))
    box = model.geom("a_collision")
    assert box.type[0] == int(mujoco.mjtGeom.mjGEOM_BOX)
    np.testing.assert_allclose(np.sort(box.size), [0.0005, 0.5, 1])
    np.testing.assert_allclose(box.pos, [0.5, 1, 0], atol=1e-9)
    assert model.geom("a_visual").type[0] == int(mujoco.mjtGeom.mjGEOM_MESH)
    assert conversion.report.warnings == ("/robot/link[a]/collision: a flat collider became a thin box",)


@pytest.mark.parametrize(
    ("file", "data", "reason"),
    [
        ("part.ply", b"ply", ".ply is not a supported mesh format"),
        ("part.obj", b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "no surface"),
        ("part.dae", b"<COLLADA><scene><instance_visual_scene url='#x'/></scene></COLLADA>", "damaged"),
    ],
)
def test_an_unreadable_mesh_is_left_out_and_a_lost_collider_is_a_warning(tmp_path, file, data, reason):
    (tmp_path / file).write_bytes(data)
    _, conversion = made(tmp_path, link("a", mesh(file)))
    assert reason in left(conversion)["/robot/link[a]/visual visual"]
    assert warned(conversion) == ()
    _, conversion = made(tmp_path, link("a", mesh(file, "collision")))
    (warning,) = warned(conversion)
    assert reason in warning


# ---------------------------------------------------------------- where files are
@pytest.mark.parametrize(
    "name",
    [
        "package://my_robot/meshes/part.obj",
        "$(find my_robot)/meshes/part.obj",
        "$(find-pkg-share my_robot)/meshes/part.obj",
        "model://my_robot/meshes/part.obj",
        "../meshes/part.obj",
        "meshes/part.obj",
        "package://another_name/meshes/part.obj",
        "file://{folder}/my_robot/meshes/part.obj",
        "file:///home/someone/ws/install/share/my_robot/meshes/part.obj",
        "file:///home/someone/src/my_robot/meshes/part.obj",
        "file:///home/some%20one/share/my_robot/me%73hes/part.obj",
        "/home/someone/ws/install/share/my_robot/meshes/part.obj",
    ],
)
def test_meshes_are_found_without_a_ros_installation(tmp_path, name):
    package = tmp_path / "my_robot"
    for folder in ("urdf", "meshes"):
        (package / folder).mkdir(parents=True)
    (package / "meshes" / "part.obj").write_text(obj())
    source = write(package / "urdf", link("a", mesh(name.format(folder=tmp_path))))
    report = convert(source, tmp_path / "out.xml").report
    assert (report.totals["visuals"], set(report.layers)) == (1, {"bot.urdf", "../meshes/part.obj"})


def test_a_path_of_another_machine_does_not_match_by_its_last_parts_alone(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "part.obj").write_text(obj())
    _, conversion = made(tmp_path, link("a", mesh("file:///home/someone/collision/meshes/part.obj")))
    assert conversion.report.unresolved == ("file:///home/someone/collision/meshes/part.obj",)


def test_a_package_is_searched_by_its_name_first(tmp_path):
    for folder in ("my_robot/urdf/meshes", "my_robot/meshes"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "part.obj").write_text(obj())
    source = write(tmp_path / "my_robot" / "urdf", link("a", mesh("package://my_robot/meshes/part.obj")))
    assert set(source_digest(source)) == {"bot.urdf", "../meshes/part.obj"}


def test_mujocos_own_folder_of_meshes_counts(tmp_path):
    (tmp_path / "parts" / "arm").mkdir(parents=True)
    (tmp_path / "parts" / "arm" / "part.obj").write_text(obj())
    (tmp_path / "parts" / "leg.obj").write_text(obj())
    extension = '<mujoco><compiler meshdir="parts" balanceinertia="true"/></mujoco>'
    names = ("arm/part.obj", "elsewhere/leg.obj", "package://x/part.obj")
    _, conversion = made(tmp_path, extension + link("a", "".join(map(mesh, names))))
    assert conversion.report.totals["visuals"] == 2
    assert conversion.report.unresolved == ("package://x/part.obj",)
    assert "/robot/mujoco/compiler balanceinertia" in left(conversion)


NAMES = ["gone.stl", "package://x/gone.stl", "http://example.org/part.stl", "a\x7fb.stl", "x" * 300 + ".stl"]


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_mesh_is_named_and_the_robot_is_converted(tmp_path, name):
    _, conversion = made(tmp_path, link("a", mesh(name) + mesh(name, "collision")))
    assert conversion.report.unresolved == (name,)
    assert warned(conversion) == (
        f"/robot/link[a]/collision: a collider was left out: mesh '{name}': the file is missing",
        f"not found, read without it: {name}",
    )


def test_a_mesh_that_git_lfs_has_not_fetched_is_reported(tmp_path):
    (tmp_path / "part.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    _, conversion = made(tmp_path, link("a", mesh("part.stl", "collision")))
    assert "git lfs pull" in warned(conversion)[0]
