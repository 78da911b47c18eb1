"""A malformed robot file gives an MJCF that MuJoCo loads, or one error message that names the mistake and its place."""

from __future__ import annotations

import random
import re

import mujoco
import numpy as np
import pytest
from effort import bytecodes
from pxr import Sdf, Usd, UsdUtils

from wheelleg_exp.asset import convert
from wheelleg_exp.asset.robot_description import unique_names
from wheelleg_exp.errors import AssetError

from ..small_usd import SI, applied, converted, cube_inside, hinge, link, two_links, write


def told(path, **options) -> AssetError:
    with pytest.raises(AssetError) as caught:
        convert(path, path.parent / "out" / "bot.xml", **options)
    return caught.value


def gprim(kind: str, text: str = "", apis: str = "PhysicsCollisionAPI") -> str:
    return f'def {kind} "shape" {applied(apis)}\n{{\n{text}\n}}\n'


# ---------------------------------------------------------------- refused values
def mass(text: str) -> str:
    return link("a", mass=text)


def joint(text: str) -> str:
    return link("a") + link("b") + hinge("j", "a", "b", apis="PhysicsDriveAPI:angular", text=text)


def shape(kind: str, text: str) -> str:
    return link("a", inside=gprim(kind, text))


def triangle(corner: str, indices: str) -> str:
    points = f"point3f[] points = [(0,0,0),(1,0,0),(0,1,0),{corner}]\n"
    return shape("Mesh", f"{points}int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [{indices}]")


AXES = "float3 physics:diagonalInertia = (1, 1, 1)\nfloat3 physics:principalAxes = (1, 0, 0)"
REFUSED = [  # a robot, and texts of its error
    (mass("float physics:mass = inf"), "/bot/a", "'physics:mass'"),
    (mass("point3f physics:centerOfMass = (nan, 0, 0)"), "/bot/a", "'physics:centerOfMass'"),
    (mass("double[] newton:inertia = [1, 1, 1e300, 0, 0, 0]"), "/bot/a", "'newton:inertia'"),
    (mass('string physics:mass = "heavy"'), "/bot/a", "expected a number"),
    (mass(AXES), "/bot/a", "expected 4 numbers"),
    (mass('token physics:kinematicEnabled = "yes"'), "/bot/a", "expected true or false"),
    (joint("float drive:angular:physics:stiffness = nan"), "/bot/j", "'drive:angular:physics:stiffness'"),
    (joint("float physics:lowerLimit = nan"), "/bot/j", "'physics:lowerLimit'"),
    (joint("point3f physics:localPos1 = (inf, 0, 0)"), "/bot/j", "'physics:localPos1'"),
    (shape("Sphere", "double radius = nan"), "/bot/a/shape", ""),
    (shape("Cube", "double size = 1e300"), "/bot/a/shape", ""),
    (shape("Capsule", "double height = nan"), "/bot/a/shape", ""),
    (triangle("(0,0,inf)", "0,1,2"), "/bot/a/shape", ""),
    (triangle("(0,0,1e30)", "0,1,3"), "/bot/a/shape", ""),
    (link("a", "(nan, 0, 0)"), "/bot/a", ""),
    (link("a", "(0, 1e300, 0)"), "/bot/a", ""),
]


@pytest.mark.parametrize(("body", "key", "words"), REFUSED)
def test_a_wrong_value_is_refused_with_its_prim(tmp_path, body, key, words):
    error = told(write(tmp_path, body))
    assert error.key == key
    assert words in str(error)
    assert "'" not in words or error.where == "bot.usda"


@pytest.mark.parametrize("name", ["metersPerUnit", "kilogramsPerUnit"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1e300"])
def test_units_that_no_stage_has_are_refused(tmp_path, name, value):
    header = SI.replace("metersPerUnit = 1\n", "") + f"\n    {name} = {value}"
    error = told(write(tmp_path, link("a"), header=header))
    assert name in error.message
    assert "bot.usda" in error.where


# ---------------------------------------------------------------- accepted values
@pytest.mark.parametrize("text", ["int physics:mass = 2", "double physics:mass = 2", "half physics:mass = 2"])
def test_a_number_of_another_type_is_a_number(tmp_path, text):
    model, _ = converted(write(tmp_path, link("a", mass=text)))
    assert model.body("a").mass[0] == 2


TETRAHEDRON = "point3f[] points = [(0,0,0),(1,0,0),(0,1,0),(0,0,1)]\nint[] faceVertexIndices = [0,1,2]\n"
MESHES = ['string points = "x"', "int[] points = [1, 2, 3]", 'string faceVertexCounts = "x"']
MESHES += ["float[] faceVertexIndices = [0.5]"]
MESHES += [f"{TETRAHEDRON}int[] faceVertexCounts = {counts}" for counts in ("[-3, 6]", "[2147483647]", "[3, 3]")]


@pytest.mark.parametrize("text", MESHES)
def test_a_mesh_with_wrong_types_or_counts_is_left_out_by_name(tmp_path, text):
    _, done = converted(write(tmp_path, link("a", inside=gprim("Mesh", text))))
    assert done.description.colliders == ()
    assert any("/bot/a/shape" in item.values for item in done.report.left_out)
    assert any("/bot/a/shape" in text for text in done.report.warnings)


def test_values_and_poses_with_time_samples_alone_are_read_at_their_start(tmp_path):
    timed = "float physics:mass.timeSamples = { 1: 2.5, 2: 7 }\nfloat3 physics:diagonalInertia = (1, 1, 1)"
    path = write(tmp_path, link("a", "(0, 0, 3)", mass=timed))
    path.write_text(path.read_text().replace("translate = (0, 0, 3)", "translate.timeSamples = { 5: (0, 0, 3) }"))
    model, done = converted(path)
    assert (model.body("a").mass[0], model.body("a").pos.tolist()) == (2.5, [0, 0, 3])
    assert any(item.path == "/bot/a.physics:mass" for item in done.report.assumptions)


# ---------------------------------------------------------------- joints
def test_a_joint_to_itself_joins_nothing(tmp_path):
    _, done = converted(write(tmp_path, link("a") + hinge("j", "a", "a")))
    assert done.description.dofs == ()
    assert any(item.name == "PhysicsRevoluteJoint" and "/bot/j" in item.values for item in done.report.left_out)


@pytest.mark.parametrize("axis", ['""', '"W"', '"x"'])
def test_an_invalid_axis_is_x_and_noted(tmp_path, axis):
    model, done = two_links(tmp_path, f"uniform token physics:axis = {axis}")
    assert model.joint("j").axis.tolist() == [1, 0, 0]
    assert any(item.path == "/bot/j" for item in done.report.assumptions)


# ---------------------------------------------------------------- composition
@pytest.mark.parametrize(
    ("inside", "header", "words"),
    [
        ('def Xform "again" (references = </bot>)\n{\n}\n', SI, ("cycle", "/bot/again")),
        ("", SI + "\n    subLayers = [@./other.usda@]", ("cycle",)),
        ("", SI.replace('"bot"', '"robot"'), ("'robot'",)),
    ],
)
def test_cycles_and_a_missing_default_prim_are_reported_and_the_robot_is_read(tmp_path, inside, header, words):
    (tmp_path / "other.usda").write_text("#usda 1.0\n(\n    subLayers = [@./bot.usda@]\n)\n")
    model, done = converted(write(tmp_path, link("a") + inside, header=header))
    assert model.nbody == 2
    assert any(all(word in text for word in words) for text in done.report.warnings)


@pytest.mark.parametrize(
    ("kind", "said"), [('over "bot"', "over"), ('class "bot"', "class"), ('def Xform "bot" (active = false)', "active")]
)
def test_a_default_prim_that_defines_nothing_is_refused(tmp_path, kind, said):
    path = write(tmp_path, link("a"))
    path.write_text(path.read_text().replace('def Xform "bot" ', kind))
    assert said in told(path).message


def test_a_robot_in_another_variant_names_the_variants(tmp_path):
    path = tmp_path / "bot.usda"
    head = '#usda 1.0\n(\n defaultPrim = "bot"\n)\ndef Xform "bot" (\n variants = { string Physics = "None" }\n'
    head += ' prepend variantSets = "Physics"\n)\n{\n variantSet "Physics" = {\n "None" {\n }\n "PhysX" {\n'
    path.write_text(f"{head}{link('a')} }}\n }}\n}}\n")
    assert "Physics: None, PhysX" in told(path).expected
    model, _ = converted(path, variants={"Physics": "PhysX"})
    assert model.nbody == 2


BALL = link("z", "(0, 0, 9)", inside='def Sphere "s" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n')


def missing(asset: str, holder: str = "parts") -> str:
    return link("a") + f'def Xform "{holder}" (references = @{asset}@)\n{{\n}}\n'


@pytest.mark.parametrize("asset", ["bot_physics.usd", "configuration/colliders.usd", "./looks.usda"])
def test_a_missing_layer_is_judged_by_what_it_was_referenced_for_and_not_by_its_name(tmp_path, asset):
    error = told(write(tmp_path, missing(asset, "collisions")))
    assert asset.removeprefix("./") in error.message
    for holder, level in (("visuals", "check"), ("parts", "doubtful")):
        _, done = converted(write(tmp_path, missing(asset, holder) + BALL))
        assert done.report.verdict.level == level
        (found,) = [item for item in done.report.findings if item.kind == "layer_not_found"]
        assert found.numbers == {"places": 1, "looks": level == "check"}


BOTH = 'def Xform "visuals" (references = @p.usd@)\n{\n}\ndef Xform "collisions" (references = @p.usd@)\n{\n}\n'
COLLIDER = 'def Xform "c" (\nprepend apiSchemas = ["PhysicsCollisionAPI"]\nreferences = @meshes.usd@)\n{\n}\n'


@pytest.mark.parametrize(
    ("body", "key", "words"),
    [
        (link("a", inside=BOTH), "/bot/a/collisions", ["p.usd"]),
        (link("a", inside=COLLIDER), "/bot/a/c", ["meshes.usd"]),
        (missing("arm.usd") + hinge("j", "a", "parts/arm"), "/bot/parts", ["arm.usd", "/bot/j"]),
    ],
    ids=["seen and collides", "collides", "joined"],
)
def test_a_missing_layer_that_a_collider_or_joint_needs_is_an_error_that_names_it(tmp_path, body, key, words):
    error = told(write(tmp_path, body))
    assert error.key == key
    assert all(word in error.message for word in words)


def test_a_missing_sublayer_is_an_error_when_nothing_joins_the_bodies(tmp_path):
    path = write(tmp_path, link("a") + link("b", "(1, 0, 0)"))
    converted(path)
    path.write_text(path.read_text().replace("(\n", "(\n    subLayers = [@other.usda@]\n", 1))
    assert "nothing joins the bodies" in told(path).message


@pytest.mark.parametrize("asset", ["textures/wood.usda", "../Materials/steel.usd", "bot_visuals.usd", "mat.mdl"])
def test_a_missing_layer_for_looks_is_omitted_and_reported(tmp_path, asset):
    _, done = converted(write(tmp_path, missing(asset)))
    (layer,) = done.report.unresolved
    assert asset.split("/")[-1] in layer


def test_a_layer_outside_the_files_folder_is_read_and_noted(tmp_path):
    for folder in ("Materials", "bot"):
        (tmp_path / folder).mkdir()
    (tmp_path / "Materials" / "m.usda").write_text('#usda 1.0\n(\n defaultPrim = "m"\n)\ndef Scope "m"\n{\n}\n')
    _, done = converted(write(tmp_path / "bot", missing("../Materials/m.usda")))
    assert any("../Materials/m.usda" in item.rule for item in done.report.assumptions)


# ---------------------------------------------------------------- files


BROKEN = [("usdc", 0.05), ("usdc", 0.5), ("usdc", 0.98), ("usdz", 0.05), ("usdz", 0.5)]


@pytest.mark.parametrize(("suffix", "part"), BROKEN)
def test_a_truncated_file_is_refused(tmp_path, suffix, part):
    whole = tmp_path / f"whole.{suffix}"
    source = write(tmp_path, link("a", inside=cube_inside("convexHull")))
    if suffix == "usdz":
        assert UsdUtils.CreateNewUsdzPackage(str(source), str(whole))
    else:
        Sdf.Layer.FindOrOpen(str(source)).Export(str(whole))
    converted(whole)
    broken = tmp_path / f"broken.{suffix}"
    data = whole.read_bytes()
    broken.write_bytes(data[: int(part * len(data))])
    assert "broken" in str(told(broken))


# ---------------------------------------------------------------- names
def test_odd_names_give_files_that_every_disk_can_hold(tmp_path):
    cubes = "\n".join(
        cube_inside("convexHull").replace('"block"', f'"{name}"').replace("0.1", f"0.{i + 1}1")
        for i, name in enumerate(["Arm", "arm", "ünï", "x" * 3000])
    )
    model, done = converted(write(tmp_path, link("a", inside=cubes)))
    files = sorted(path.name for path in (done.output.parent / "bot_meshes").iterdir())
    assert (model.nmesh, len({name.lower() for name in files})) == (4, 4)
    assert all(len(name.encode()) < 255 and re.fullmatch(r"[\w.-]+", name) for name in files)


def test_a_display_name_with_control_characters_is_not_used(tmp_path):
    path = write(tmp_path, link("tn__x").replace("prepend", 'displayName = "a\\tb"\n prepend'))
    _, done = converted(path)
    assert done.description.bodies[0].name == "tn__x"


def test_a_display_name_that_climbs_becomes_a_plain_file(tmp_path):
    block = cube_inside("convexHull").replace('"block" (', '"tn__x" (\n displayName = "../../../climb"')
    _, done = converted(write(tmp_path, link("a", inside=block)))
    assert [path.name for path in (done.output.parent / "bot_meshes").iterdir()] == ["a__________climb.obj"]


# ---------------------------------------------------------------- shapes
def test_polygons_become_fans_without_the_holes(tmp_path):
    text = "point3f[] points = [(0,0,0),(1,0,0),(1,1,0),(0,1,0),(0,0,1)]\nint[] faceVertexCounts = [4, 3, 3, 0, 2]\n"
    text += "int[] faceVertexIndices = [0,1,2,3, 0,1,4, 1,2,4, 3,4]\nint[] holeIndices = [1, 99]"
    _, done = converted(write(tmp_path, link("a", inside=gprim("Mesh", text))))
    assert done.description.meshes[0].faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 4]]


@pytest.mark.parametrize(
    ("inside", "kind"),
    [
        (gprim("Capsule", "double radius = 0.2\ndouble height = 0"), mujoco.mjtGeom.mjGEOM_SPHERE),
        (gprim("Cone", "double height = 1e-300"), mujoco.mjtGeom.mjGEOM_BOX),
        (gprim("Cone", "double height = 1e-300", apis=""), mujoco.mjtGeom.mjGEOM_BOX),
        (cube_inside("convexHull").replace("0.1", "0.000002"), mujoco.mjtGeom.mjGEOM_MESH),
    ],
)
def test_a_shape_without_height_or_of_tiny_size_is_one_that_mujoco_builds(tmp_path, inside, kind):
    model, _ = converted(write(tmp_path, link("a", inside=inside)))
    assert list(model.geom_type) == [int(kind)]


@pytest.mark.parametrize("kind", ["Capsule_1", "Cylinder_1"])
def test_the_newer_round_shapes_are_read(tmp_path, kind):
    equal = "double radiusTop = 0.2\ndouble radiusBottom = 0.2\ndouble height = 1"
    model, _ = converted(write(tmp_path, link("a", inside=gprim(kind, equal))))
    assert model.geom_size[0, :2].tolist() == [0.2, 0.5]
    taper = equal.replace("Bottom = 0.2", "Bottom = 0.4")
    model, done = converted(write(tmp_path, link("a", inside=gprim(kind, taper))))
    assert model.geom_type[0] == int(mujoco.mjtGeom.mjGEOM_MESH)
    assert np.abs(done.description.meshes[0].vertices[:, :2]).max() == pytest.approx(0.4)


def test_a_plane_on_a_moving_body_is_drawn_and_does_not_collide(tmp_path):
    _, done = converted(write(tmp_path, link("a", inside=gprim("Plane"))))
    assert any("/bot/a/shape" in text for text in done.report.warnings)
    drawn = gprim("Plane", 'double width = 4\ndouble length = 2\nuniform token axis = "X"', apis="")
    model, _ = converted(write(tmp_path, link("a", inside=drawn)))
    assert model.geom_size[0].tolist() == [0.0005, 1, 2]


def test_a_mirrored_ground_is_solid_on_the_same_side(tmp_path):
    turned = "double3 xformOp:scale = (1, 1, -1)\nuniform token[] xformOpOrder = ['xformOp:scale']".replace("'", '"')
    model, _ = converted(write(tmp_path, link("a") + gprim("Plane", turned)))
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, np.array([0.0, 0, 1]), model.geom_quat[0])
    assert normal.round(9).tolist() == [0, 0, -1]


def test_a_point_instancer_is_left_out_with_a_warning(tmp_path):
    text = f'def PointInstancer "many"\n{{\nrel prototypes = </bot/a/many/shape>\n{gprim("Sphere")}\n}}\n'
    _, done = converted(write(tmp_path, link("a", inside=text)))
    assert any("/bot/a/many: a PointInstancer was left out" in warning for warning in done.report.warnings)
    assert done.description.colliders == ()


# ---------------------------------------------------------------- size
def test_names_take_time_in_proportion_to_their_number():
    def effort(count: int) -> int:
        paths = [f"/g{i}" + "/a" * 8 for i in range(count)]
        assert len(set(unique_names(paths).values())) == count
        return bytecodes(lambda: unique_names(paths))

    assert effort(4_000) < 9 * effort(500)  # Linear effort is 8 times larger, and quadratic effort is 64 times larger.
    deep = unique_names("/" + "/".join(["a"] * n) for n in range(1, 2_000))
    assert len(set(deep.values())) == 1_999


# ---------------------------------------------------------------- a small fuzz
NUMBERS = [float("nan"), float("inf"), 0.0, -1.0, 1e300, 3.4e38, 1e-300, 1e12]
TYPES = {"string": "abc", "token": "X", "bool": True, "float[]": [1.0, 2.0], "double": 1e300, "float3": (1, 2, 3)}
KINDS = ["Xform", "Sphere", "Mesh", "Plane", "PhysicsFixedJoint", "PhysicsJoint", "PhysicsScene", "PointInstancer", "X"]


def mutated(layer: Sdf.Layer, dice: random.Random) -> None:
    """Change a number, a type, a prim's type, or a target of a USD layer, or remove a prim."""
    paths: list[Sdf.Path] = []
    layer.Traverse("/", paths.append)
    attributes = [p for p in paths if layer.GetAttributeAtPath(p)]
    prims = [p for p in paths if p.IsPrimPath() and len(p.GetPrefixes()) > 1]
    links = [p for p in paths if layer.GetRelationshipAtPath(p)]
    act = dice.randrange(6)
    if act == 0:
        spec = layer.GetAttributeAtPath(dice.choice(attributes))
        if isinstance(spec.default, float):
            spec.default = dice.choice(NUMBERS)
    elif act == 1:
        path = dice.choice(attributes)
        prim = layer.GetPrimAtPath(path.GetPrimPath())
        del prim.properties[path.name]
        kind, value = dice.choice(list(TYPES.items()))
        value_type = getattr(Sdf.ValueTypeNames, kind, None) or Sdf.ValueTypeNames.Find(kind)
        Sdf.AttributeSpec(prim, path.name, value_type).default = value
    elif act == 2:
        layer.GetPrimAtPath(dice.choice(prims)).typeName = dice.choice(KINDS)
    elif act == 3 and links:
        targets = layer.GetRelationshipAtPath(dice.choice(links)).targetPathList
        targets.ClearEditsAndMakeExplicit()
        targets.explicitItems.append(dice.choice([*prims, Sdf.Path("/nowhere"), *attributes]))
    elif act == 4:
        spec = layer.GetPrimAtPath(dice.choice(prims))
        del spec.nameParent.nameChildren[spec.name]
    else:
        layer.GetPrimAtPath(dice.choice(prims)).specifier = dice.choice([Sdf.SpecifierOver, Sdf.SpecifierClass])


@pytest.mark.parametrize("seed", range(60))
def test_a_changed_layer_gives_a_model_or_one_error_message(tmp_path, seed):
    dice = random.Random(seed)
    body = link("a", inside=cube_inside("convexHull")) + link("b", "(1, 0, 0)", inside=gprim("Capsule"))
    body += hinge("j", "a", "b", apis="PhysicsDriveAPI:angular", text="float drive:angular:physics:stiffness = 1")
    body += hinge("w", "b", "a", kind="Fixed") + gprim("Plane")
    layer = Sdf.Layer.FindOrOpen(str(write(tmp_path, body)))
    for _ in range(dice.randint(1, 3)):
        mutated(layer, dice)
    path = tmp_path / "changed.usda"
    layer.Export(str(path))
    try:
        done = convert(path, tmp_path / "out" / "bot.xml")
    except AssetError as error:
        said = error
    else:
        mujoco.mj_forward(model := mujoco.MjModel.from_xml_path(str(done.output)), mujoco.MjData(model))
        return
    assert said.key or said.where
    assert len(str(said)) < 600
    assert not list(tmp_path.glob("out/*"))


def test_openusd_prints_nothing(tmp_path, capfd):
    converted(write(tmp_path, missing("textures/wood.usda")))
    told(write(tmp_path, missing("bot_physics.usd", "collisions")))
    assert tuple(capfd.readouterr()) == ("", "")
    assert Usd.GetVersion()
