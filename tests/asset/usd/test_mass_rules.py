"""Mass properties of bodies equal those that OpenUSD computes, which PhysX uses."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from wheelleg_exp.errors import AssetError

from ..small_usd import MASS, SI, converted, cube_inside, hinge, link, tensor, warned, write

SEEDS = range(40)
TILT = "(0.98480775, 0, 0, 0.17364818)"  # 20° about z
COS, SIN = math.cos(math.radians(20)), math.sin(math.radians(20))
TURN = np.array([[COS, -SIN, 0], [SIN, COS, 0], [0, 0, 1]])


# ------------------------------------------------------------------ the oracle
def shape_information(prim: Usd.Prim, cache: UsdGeom.XformCache) -> UsdPhysics.RigidBodyAPI.MassInformation:
    """Return volume, centre, and inertia (density 1) of a box, sphere, or cylinder by textbook formulas."""
    body = prim.GetParent()
    to_body = Gf.Transform(cache.ComputeRelativeTransform(prim, body)[0])
    scale = np.array(Gf.Transform(cache.GetLocalToWorldTransform(prim)).GetScale())
    if prim.IsA(UsdGeom.Cube):
        a, b, c = UsdGeom.Cube(prim).GetSizeAttr().Get() * scale
        volume, moments = a * b * c, [a * b * c / 12 * (q * q + r * r) for q, r in ((b, c), (a, c), (a, b))]
    elif prim.IsA(UsdGeom.Sphere):
        r = UsdGeom.Sphere(prim).GetRadiusAttr().Get() * scale[0]
        volume = 4 / 3 * math.pi * r**3
        moments = [0.4 * volume * r * r] * 3
    else:
        r = UsdGeom.Cylinder(prim).GetRadiusAttr().Get() * scale[0]
        h = UsdGeom.Cylinder(prim).GetHeightAttr().Get() * scale[2]
        volume = math.pi * r * r * h
        moments = [volume * (3 * r * r + h * h) / 12] * 2 + [volume * r * r / 2]
    info = UsdPhysics.RigidBodyAPI.MassInformation()
    info.volume = volume
    info.centerOfMass = Gf.Vec3f(0)
    info.inertia = Gf.Matrix3f(*np.diag(moments).ravel().tolist())
    stretch = np.array(Gf.Transform(cache.GetLocalToWorldTransform(body)).GetScale())
    info.localPos = Gf.Vec3f(*(np.array(to_body.GetTranslation()) * stretch).tolist())
    info.localRot = Gf.Quatf(to_body.GetRotation().GetQuat())
    return info


def expected(path: Path, mpu: float, kpu: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return OpenUSD's mass, centre of mass, and inertia tensor about the centre in the body's axes, in SI units."""
    stage = Usd.Stage.Open(str(path))
    cache = UsdGeom.XformCache()
    body = UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/bot/a"))
    mass, moments, center, axes = body.ComputeMassProperties(lambda prim: shape_information(prim, cache))
    turn = np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(axes)))).T
    inertia = turn @ np.diag(np.array(moments, float)) @ turn.T
    return mass * kpu, np.array(center, float) * mpu, inertia * kpu * mpu**2


# ------------------------------------------------------------------ random bodies
class Dice:
    """A generator of random numbers as USD text."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def one(self, low: float, high: float) -> float:
        return round(float(self.random.uniform(low, high)), 3)

    def vector(self, low: float, high: float) -> str:
        return f"({self.one(low, high)}, {self.one(low, high)}, {self.one(low, high)})"

    def quaternion(self) -> str:
        values = self.random.normal(size=4)
        return "(" + ", ".join(f"{v:.6f}" for v in values / np.linalg.norm(values)) + ")"

    def moments(self) -> str:
        base = self.one(0.01, 0.2)
        return f"({base}, {round(base * 1.3, 4)}, {round(base * 1.7, 4)})"

    def chosen(self, *options: str) -> str:
        return options[int(self.random.integers(len(options)))]


def mass_text(dice: Dice, body: bool) -> str:
    center, nowhere = f"point3f physics:centerOfMass = {dice.vector(-0.3, 0.3)}", "(-inf, -inf, -inf)"
    inertia, axes = "float3 physics:diagonalInertia =", "quatf physics:principalAxes ="
    moments = dice.chosen("", f"{inertia} (0, 0, 0)", f"{inertia} {dice.moments()}")
    turned, straight = f"{axes} {dice.quaternion()}", f"{axes} (0, 0, 0, 0)"
    lines = [
        dice.chosen("", "float physics:mass = 0", f"float physics:mass = {dice.one(0.1, 3)}"),
        dice.chosen("", "float physics:density = 0", f"float physics:density = {dice.one(50, 3000)}"),
        dice.chosen("", f"point3f physics:centerOfMass = {nowhere}", center),
        moments,
        "" if not body else turned if "(0, 0, 0)" not in moments and moments else dice.chosen("", straight),
    ]
    return "\n".join(line for line in lines if line)


def collider(dice: Dice, name: str) -> str:
    kind = dice.chosen("Cube", "Sphere", "Cylinder")
    size = {"Cube": "size = 0.3", "Sphere": "radius = 0.2", "Cylinder": "radius = 0.1\n double height = 0.5"}[kind]
    across, cubic, high = dice.one(0.5, 2), dice.vector(0.5, 2), dice.one(0.5, 2)
    scale = {"Cube": cubic, "Sphere": f"({across}, {across}, {across})", "Cylinder": f"({across}, {across}, {high})"}[
        kind
    ]
    turn = "(1, 0, 0, 0)" if kind == "Sphere" else dice.quaternion()  # a sphere's axes are arbitrary
    material = dice.chosen("", "rel material:binding:physics = </bot/heavy>")
    return f"""
        def {kind} "{name}" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI", "MaterialBindingAPI"])
        {{
            double {size}
            {material}
            {mass_text(dice, body=False)}
            double3 xformOp:translate = {dice.vector(-0.5, 0.5)}
            quatd xformOp:orient = {turn}
            double3 xformOp:scale = {scale}
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", "xformOp:scale"]
        }}
"""


def random_body(folder: Path, seed: int) -> tuple[Path, float, float]:
    dice = Dice(seed)
    inside = "".join(collider(dice, f"c{i}") for i in range(int(dice.random.integers(1, 4))))
    mpu, kpu = (1.0, 1.0) if seed % 3 else (0.01, 0.001)
    header = f'defaultPrim = "bot"\n metersPerUnit = {mpu}\n kilogramsPerUnit = {kpu}\n upAxis = "Z"'
    material = 'def Material "heavy" (prepend apiSchemas = ["PhysicsMaterialAPI"]) { float physics:density = 4000; }\n'
    body = link("a", dice.vector(-1, 1), mass=mass_text(dice, body=True), inside=inside)
    if dice.random.random() < 0.4:
        scaled = '["xformOp:translate", "xformOp:scale"]\n double3 xformOp:scale = (2, 2, 2)'
        body = body.replace('["xformOp:translate"]', scaled)
    return write(folder, body + material, header=header), mpu, kpu


@pytest.mark.parametrize("seed", SEEDS)
def test_mass_properties_are_those_of_openusd(tmp_path, seed):
    path, mpu, kpu = random_body(tmp_path, seed)
    model, done = converted(path)
    mass, center, inertia = expected(path, mpu, kpu)
    if any("A + B < C" in item.rule for item in done.report.assumptions):
        pytest.skip("moments that MuJoCo refuses")
    body = model.body("a")
    assert body.mass[0] == pytest.approx(mass, rel=1e-5)
    np.testing.assert_allclose(body.ipos, center, atol=1e-5 * max(1e-3, np.abs(center).max()))
    np.testing.assert_allclose(tensor(model, "a"), inertia, atol=2e-4 * np.abs(inertia).max())


# ------------------------------------------------------------------ one rule each
def cube(name: str, mass: str = "", *, at: str = "(0, 0, 0)", more: str = "") -> str:
    return f"""
        def Cube "{name}" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI", "MaterialBindingAPI"])
        {{
            double size = 0.2
            {mass}
            {more}
            double3 xformOp:translate = {at}
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
"""


def test_a_mass_on_a_collider_that_is_an_xform_goes_for_all_shapes_below_together(tmp_path):
    moved = 'double size = 0.2; double3 xformOp:translate = ({}, 0, 0); token[] xformOpOrder = ["xformOp:translate"];'
    parts = "\n".join(f'def Cube "c{x}" {{ {moved.format(x)} }}' for x in (1, 3))
    head = 'def Xform "collisions" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"])'
    inside = f"{head} {{ float physics:mass = 5\n{parts}\n}}"
    model, _ = converted(write(tmp_path, link("a", mass="", inside=inside)))
    assert model.body("a").mass[0] == pytest.approx(5)
    np.testing.assert_allclose(model.body("a").ipos, [2, 0, 0], atol=1e-9)


LEAD = 'def Material "lead" (prepend apiSchemas = ["PhysicsMaterialAPI"]) { float physics:density = 11340; }\n'
BOUND = "rel material:binding:physics = </bot/lead>"


def test_moments_without_axes_go_along_the_colliders_axes_as_in_physx(tmp_path):
    mass = "float physics:mass = 1\n float3 physics:diagonalInertia = (0.1, 0.2, 0.25)"
    scaled = f"quatd xformOp:orient = {TILT}\n float3 xformOp:scale = (1, 2, 3)"
    box = cube("c").replace("double3 xformOp:translate = (0, 0, 0)", scaled)
    box = box.replace('["xformOp:translate"]', '["xformOp:orient", "xformOp:scale"]')
    model, done = converted(write(tmp_path, link("a", mass=mass, inside=box)))
    np.testing.assert_allclose(tensor(model, "a"), TURN @ np.diag([0.1, 0.2, 0.25]) @ TURN.T, atol=1e-6)
    assert any("no principal axes" in item.rule for item in done.report.assumptions)


def test_axes_without_moments_turn_the_colliders_moments_as_in_physx(tmp_path):
    mass = f"float physics:mass = 12\n quatf physics:principalAxes = {TILT}"
    box = cube("c").replace("double3 xformOp:translate = (0, 0, 0)", "float3 xformOp:scale = (1, 2, 3)")
    box = box.replace('["xformOp:translate"]', '["xformOp:scale"]')
    model, _ = converted(write(tmp_path, link("a", mass=mass, inside=box)))
    a, b, c = 0.2, 0.4, 0.6
    moments = np.diag([b * b + c * c, a * a + c * c, a * a + b * b])  # m/12 = 1
    np.testing.assert_allclose(tensor(model, "a"), TURN @ moments @ TURN.T, atol=1e-6)


@pytest.mark.parametrize(("units", "mass"), [("metersPerUnit = 0.01\n kilogramsPerUnit = 0.001", 0.001), ("", 1.0)])
def test_a_body_without_mass_and_shapes_is_physx_ball_of_one_unit_of_mass(tmp_path, units, mass):
    header = SI.replace("metersPerUnit = 1", units or "metersPerUnit = 1")
    model, _ = converted(write(tmp_path, link("a", mass=""), header=header))
    assert model.body("a").mass[0] == pytest.approx(mass)
    np.testing.assert_allclose(tensor(model, "a"), np.eye(3) * 0.4 * mass * 0.1**2)


@pytest.mark.parametrize("moments", ["(0.1, 0.1, 0.2000001)", "(0.1, 0.1, 0.9)", "(0.1, 0.2, 0)", "(-0.1, 0.1, 0.1)"])
def test_moments_that_mujoco_refuses_are_cut_and_reported(tmp_path, moments):
    model, done = converted(write(tmp_path, link("a", mass=MASS.replace("(0.1, 0.1, 0.1)", moments))))
    a, b, c = sorted(model.body("a").inertia)
    assert a > 0
    assert a + b >= c
    cut = moments != "(-0.1, 0.1, 0.1)"
    assert any("moments that no body can have" in item.rule for item in done.report.assumptions) is cut
    assert any("/bot/a" in warning for warning in done.report.warnings) is (moments != "(0.1, 0.1, 0.2000001)")


def test_a_mass_too_small_for_mujoco_is_refused_with_its_prim(tmp_path):
    with pytest.raises(AssetError, match="too small") as caught:
        converted(write(tmp_path, link("a", mass=MASS.replace("mass = 1", "mass = 1e-30"))))
    assert caught.value.key == "/bot/a"


SPECK = MASS.replace("mass = 1", "mass = 4e-15").replace("(0.1, 0.1, 0.1)", "(1.7e-27, 1.7e-27, 1.7e-27)")


def test_a_welded_frame_may_weigh_a_rounding_error(tmp_path):
    fixed = hinge("w", "a", "imu", kind="Fixed", text="point3f physics:localPos0 = (1, 0, 0)")
    model, done = converted(write(tmp_path, link("a") + link("imu", "(1, 0, 0)", mass=SPECK) + fixed))
    assert model.body("imu").mass[0] == pytest.approx(4e-15)
    np.testing.assert_allclose(model.body("imu").inertia, 1.7e-27, rtol=1e-6)
    (found,) = [item for item in done.report.findings if item.kind == "tiny_inertia"]
    assert (found.kind, found.subject, found.path) == ("tiny_inertia", "imu", "/bot/imu")
    assert found.numbers == pytest.approx({"mass": 4e-15, "largest": 1.7e-27})
    assert not warned(done)


def test_moments_too_small_for_what_moves_are_those_of_its_shapes(tmp_path):
    tiny = MASS.replace("(0.1, 0.1, 0.1)", "(1e-27, 1e-27, 1e-27)")
    model, done = converted(write(tmp_path, link("a", mass=tiny, inside=cube("cube"))))
    np.testing.assert_allclose(model.body("a").inertia, 0.2**2 / 6, rtol=1e-6)
    assert any("/bot/a" in text and "moments below" in text for text in done.report.warnings)


def test_a_switched_off_collider_still_weighs(tmp_path):
    inside = cube("cube", more="bool physics:collisionEnabled = 0")
    model, _ = converted(write(tmp_path, link("a", mass="", inside=inside)))
    assert model.body("a").mass[0] == pytest.approx(8.0)
    assert not (model.geom_contype | model.geom_conaffinity).any()


@pytest.mark.parametrize("mass", ["0\n float3 physics:diagonalInertia = (0, 0, 0)", "-3"])
def test_a_mass_that_is_not_positive_means_not_given_and_is_reported(tmp_path, mass):
    model, done = converted(write(tmp_path, link("a", mass=f"float physics:mass = {mass}", inside=cube("cube"))))
    assert model.body("a").mass[0] == pytest.approx(1000 * 0.2**3)
    np.testing.assert_allclose(tensor(model, "a"), np.eye(3) * 8 * 0.2**2 / 6, rtol=1e-6)
    assert any(item.name == "physics:mass" and "/bot/a" in item.values for item in done.report.left_out)
    assert any("/bot/a" in warning and "-3" in warning for warning in done.report.warnings) is (mass == "-3")


CENTER = "float physics:mass = 2\n point3f physics:centerOfMass = (0, 0, 0.5)"
TURNED = "float physics:mass = 1\n float3 physics:diagonalInertia = (0.1, 0.2, 0.25)\n"
TURNED += "quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)"
FULL = MASS + "\n float[] newton:inertia = [0.3, 0.2, 0.25, 0.01, 0, 0]"
OWN = 2 * 0.2**2 / 6


@pytest.mark.parametrize(
    ("mass", "inside", "expected"),
    [
        (CENTER, cube("cube"), np.diag([OWN + 2 * 0.25, OWN + 2 * 0.25, OWN])),
        (TURNED, "", np.diag([0.2, 0.1, 0.25])),
        (FULL, "", [[0.3, 0.01, 0], [0.01, 0.2, 0], [0, 0, 0.25]]),
    ],
    ids=["colliders about an authored centre", "principal axes", "newton's full tensor"],
)
def test_the_tensor_is_about_the_centre_in_the_bodys_axes(tmp_path, mass, inside, expected):
    model, _ = converted(write(tmp_path, link("a", mass=mass, inside=inside)))
    np.testing.assert_allclose(tensor(model, "a"), expected, rtol=1e-6, atol=1e-7)


def shape(kind: str, text: str, scale: str = "(1, 1, 1)") -> str:
    scaled = f'double3 xformOp:scale = {scale}\n uniform token[] xformOpOrder = ["xformOp:scale"]'
    return f'def {kind} "shape" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{{\n{text}\n{scaled}\n}}'


LYING = 'double radius = 0.1\n double height = 0.5\n token axis = "X"'


@pytest.mark.parametrize(
    ("inside", "volume"),
    [  # PhysX's volumes
        (shape("Sphere", "double radius = 0.2", "(1.5, 1, 0.7)"), 4 / 3 * math.pi * 0.3**3),
        (shape("Cylinder", LYING, "(2, 1, 0.7)"), math.pi * 0.01),
        (shape("Cone", "double radius = 0.1\n double height = 0.5"), math.pi * 0.01 * 0.5 / 3),
        (shape("Cone", "double radius = 0.1\n double height = 0.5", "(1.5, 1, 1)"), math.pi * 0.0225 * 0.5 / 3),
    ],
    ids=["sphere", "cylinder", "cone", "oval cone"],
)
def test_an_unevenly_scaled_shape_weighs_as_with_its_largest_scale_across(tmp_path, inside, volume):
    model, _ = converted(write(tmp_path, link("a", mass="", inside=inside)))
    np.testing.assert_allclose(model.body("a").mass[0], 1000 * volume, rtol=1e-6)


CONES = [("Z", 1, [0, 0, -0.15]), ("Y", 1, [0, -0.15, 0]), ("Z", -1, [0, 0, 0.15])]


@pytest.mark.parametrize(("axis", "flip", "center"), CONES)
def test_a_cone_weighs_as_a_cone_and_not_as_its_hull(tmp_path, axis, flip, center):
    """A cone's centre is h/4 above its base, and its moments are 3/10 m r² and m(3/20 r² + 3/80 h²)."""
    inside = shape("Cone", f'double radius = 0.2\n double height = 0.6\n token axis = "{axis}"', f"(1, 1, {flip})")
    model, _ = converted(write(tmp_path, link("a", mass="float physics:mass = 2", inside=inside)))
    np.testing.assert_allclose(model.body("a").ipos, center, atol=1e-9)
    moments = np.sort(model.body("a").inertia)
    np.testing.assert_allclose(moments, [2 * 0.3 * 0.04] + [2 * (0.15 * 0.04 + 3 / 80 * 0.36)] * 2, rtol=1e-6)


def test_a_shape_below_a_shape_collides_if_a_prim_above_both_enables_it(tmp_path):
    inner = 'def Cube "c" {own}\n{{\n double size = 0.2\n def Sphere "s"\n {{\n double radius = 0.3\n }}\n}}\n'
    api = '(prepend apiSchemas = ["PhysicsCollisionAPI"])'
    group = f'def Xform "g" {api}\n{{\n{inner.format(own="")}}}\n'
    both, _ = converted(write(tmp_path, link("a", mass="", inside=group)))
    np.testing.assert_allclose(both.body("a").mass[0], 1000 * (0.008 + 4 / 3 * math.pi * 0.027), rtol=1e-6)
    one, _ = converted(write(tmp_path, link("a", mass="", inside=inner.format(own=api))))
    np.testing.assert_allclose(one.body("a").mass[0], 8, rtol=1e-6)


# ------------------------------------------------------------------ hollow bodies
SIZES = {  # USD attributes, and MuJoCo's size
    "Cube": ("double size = 0.2", "box", [0.1, 0.2, 0.3], "(1, 2, 3)"),
    "Sphere": ("double radius = 0.1", "sphere", [0.1], "(1, 1, 1)"),
    "Ellipsoid": ("double radius = 0.1", "ellipsoid", [0.1, 0.2, 0.05], "(1, 2, 0.5)"),
    "Cylinder": ("double radius = 0.1\n double height = 0.2", "cylinder", [0.1, 0.1], "(1, 1, 1)"),
    "Capsule": ("double radius = 0.1\n double height = 0.4", "capsule", [0.1, 0.2], "(1, 1, 1)"),
}
MUJOCO, NEWTON = "bool mjc:shellinertia = 1\n", 'token newton:massModel = "shell"\n'


def hollow(kind: str, text: str, density: float = 500) -> str:
    size, scale = SIZES[kind][0], SIZES[kind][3]
    return shape(kind.replace("Ellipsoid", "Sphere"), f"{size}\n float physics:density = {density}\n {text}", scale)


def compiled(kind: str, size: list[float], density: float, shell: bool) -> tuple[float, np.ndarray]:
    spec = mujoco.MjSpec()
    geom = spec.worldbody.add_body().add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), density=density)
    geom.size = [*size, 0, 0][:3]
    geom.typeinertia = mujoco.mjtGeomInertia.mjINERTIA_SHELL if shell else mujoco.mjtGeomInertia.mjINERTIA_VOLUME
    model = spec.compile()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[1])
    turn = turn.reshape(3, 3)
    return model.body_mass[1], turn @ np.diag(model.body_inertia[1]) @ turn.T


@pytest.mark.parametrize("kind", SIZES)
@pytest.mark.parametrize("text", [MUJOCO, NEWTON])
@pytest.mark.parametrize("own", ["", "float physics:mass = 3"])
def test_a_hollow_shape_without_thickness_is_mujocos_shell(tmp_path, kind, text, own):
    model, done = converted(write(tmp_path, link("a", mass=own, inside=hollow(kind, text))))
    mass, inertia = compiled(*SIZES[kind][1:3], 500, shell=True)
    scale = 3 / mass if own else 1
    np.testing.assert_allclose(model.body("a").mass, mass * scale, rtol=1e-7)
    np.testing.assert_allclose(tensor(model, "a"), inertia * scale, rtol=2e-5, atol=1e-12)
    name = text.split()[1]
    assert name in {item.name for item in done.report.mapped}
    assert done.report.totals["assumed_mass"] == 0


@pytest.mark.parametrize("kind", SIZES)
@pytest.mark.parametrize("units", [1.0, 0.01])
def test_newtons_hollow_shape_is_the_difference_of_two_solids(tmp_path, kind, units):
    wall, size = 0.02, SIZES[kind][2]
    inner = [size[0] - wall, size[1]] if kind == "Capsule" else [value - wall for value in size]
    text = NEWTON + f"float newton:shellThickness = {wall / units}"
    inside = hollow(kind, text, 500 * units**3)
    if units != 1:  # the same shape, drawn in centimetres
        inside = inside.replace("= 0.1\n", "= 10\n").replace("= 0.2\n", "= 20\n").replace("= 0.4\n", "= 40\n")
    header = SI.replace("metersPerUnit = 1", f"metersPerUnit = {units}")
    model, done = converted(write(tmp_path, link("a", mass="", inside=inside), header=header))
    (mass, inertia), (less, away) = (compiled(SIZES[kind][1], part, 500, shell=False) for part in (size, inner))
    np.testing.assert_allclose(model.body("a").mass, mass - less, rtol=1e-5)
    np.testing.assert_allclose(tensor(model, "a"), inertia - away, rtol=1e-5, atol=1e-12)
    assert {"newton:massModel", "newton:shellThickness"} <= {item.name for item in done.report.mapped}
    assert "newton:shellThickness" not in {item.name for item in done.report.left_out}


def test_a_hollow_cone_and_a_hollow_mesh_have_the_mass_of_their_walls(tmp_path):
    """The surface of a cone: π r (r + s), with the slant height s; of a cube: 6 a²."""
    thin = NEWTON + "float newton:shellThickness = 0.0001\n float physics:density = 500"
    cone = shape("Cone", f"double radius = 0.1\n double height = 0.2\n {thin}")
    model, _ = converted(write(tmp_path, link("a", mass="", inside=cone)))
    slant = math.hypot(0.1, 0.2)
    np.testing.assert_allclose(model.body("a").mass, 0.05 * math.pi * 0.1 * (0.1 + slant), rtol=2e-3)
    side = slant / (slant + 0.1)  # The lateral surface's centre is h/3 above the base.
    np.testing.assert_allclose(model.body("a").ipos, [0, 0, 0.2 / 3 * side - 0.1], atol=2e-4)
    axial = 0.05 * math.pi * 0.1 * (0.1 + slant) * 0.1**2 / 2
    np.testing.assert_allclose(tensor(model, "a")[2, 2], axial, rtol=5e-3)
    mesh = cube_inside("convexHull").replace(
        "uniform token physics:approximation", thin + "\n uniform token physics:approximation"
    )
    model, done = converted(write(tmp_path, link("a", mass="", inside=mesh.replace("0.0001", "0.002"))))
    np.testing.assert_allclose(model.body("a").mass, 6 * 0.2**2 * 0.002 * 500, rtol=1e-6)
    assert {"newton:massModel", "newton:shellThickness"} <= {item.name for item in done.report.mapped}


def test_a_wall_thicker_than_the_shape_is_solid_and_a_solid_needs_no_wall(tmp_path):
    for text in (NEWTON + "float newton:shellThickness = 7", "float newton:shellThickness = 0.001"):
        model, done = converted(write(tmp_path, link("a", mass="", inside=hollow("Sphere", text))))
        np.testing.assert_allclose(model.body("a").mass, 500 * 4 / 3 * math.pi * 0.001, rtol=1e-6)
    mesh = cube_inside("convexHull").replace("uniform", f"{NEWTON} float newton:shellThickness = 7\nuniform")
    block, _ = converted(write(tmp_path, link("a", mass="", inside=mesh)))
    np.testing.assert_allclose(block.body("a").mass, 8, rtol=1e-6)
    (left,) = [item for item in done.report.left_out if item.name == "newton:shellThickness"]
    assert "the shape is solid" in left.reason


# ------------------------------------------------------------------ what the file says, and what is assumed
HALF = cube("left", "float physics:mass = 3", at="(-1, 0, 0)") + cube("right", at="(1, 0, 0)")


@pytest.mark.parametrize(
    ("body", "inside", "mass", "assumed"),
    [
        ("float physics:mass = 2", cube("c"), 2, 0),
        ("float physics:density = 500", cube("c"), 4, 0),
        ("", cube("c", "float physics:mass = 0.05"), 0.05, 0),
        ("", cube("c", "float physics:mass = 0.05\n float physics:density = 700"), 0.05, 0),
        ("", cube("c", "float physics:density = 700"), 5.6, 0),
        ("", cube("c", BOUND), 90.72, 0),
        ("float physics:density = 500", cube("c", BOUND), 4, 0),
        ("float physics:density = 500", cube("c", "float physics:density = 250"), 2, 0),
        ("", cube("c"), 8, 8),
        ("", HALF, 11, 8),
        ("float physics:density = 500", HALF, 7, 0),
        ("float physics:mass = 2", HALF, 2, 0),
        ("", "", 1, 1),
        ("", cube("c", "float physics:mass = 0"), 8, 8),
        ("float physics:density = -5", cube("c"), 8, 8),
    ],
)
@pytest.mark.parametrize("instance", [False, True])
def test_the_report_calls_only_that_mass_assumed_that_the_file_does_not_give(
    tmp_path, body, inside, mass, assumed, instance
):
    outside = ""
    if instance and inside:
        outside = f'class Xform "proto"\n{{\n{inside}\n}}\n'
        inside = 'def Xform "shapes" (\n instanceable = true\n prepend references = </proto>\n)\n{\n}\n'
    model, done = converted(write(tmp_path, link("a", mass=body, inside=inside) + LEAD, outside=outside))
    np.testing.assert_allclose(model.body("a").mass, mass, rtol=1e-6)
    totals, report = done.report.totals, done.report
    assert (totals["mass"], totals["assumed_mass"]) == pytest.approx((mass, assumed))
    assert {item.kind for item in report.findings} & {"no_inertial"} == ({"no_inertial"} if assumed else set())
    about = [item.rule for item in report.assumptions if "mass" in item.rule or "inertia" in item.rule]
    assert bool(about) is bool(assumed)
    assert (report.verdict.level == "doubtful") is bool(assumed)
    reasons = [item.reason for item in report.left_out if any("/a/" in path for path in item.values)]
    both = "0.05" in inside + outside and "700" in inside + outside
    assert any("has mass properties of its own" in reason for reason in reasons) is both


def test_a_negative_tensor_is_read_without_its_signs(tmp_path):
    six = "float physics:mass = 1\n double[] newton:inertia = [-0.0012, -0.00119, 0.00033, 0, 0, 0]"
    for mass in (six, MASS.replace("(0.1, 0.1, 0.1)", "(-0.0012, -0.00119, 0.00033)")):
        model, done = converted(write(tmp_path, link("a", mass=mass)))
        np.testing.assert_allclose(np.diag(tensor(model, "a")), [0.0012, 0.00119, 0.00033], rtol=1e-6)
        assert any("without their signs" in text for text in done.report.warnings)
    own = cube("c", "float physics:mass = 1\n float3 physics:diagonalInertia = (-0.0012, 0.00119, 0.00033)")
    model, _ = converted(write(tmp_path, link("a", mass="", inside=own)))
    np.testing.assert_allclose(np.diag(tensor(model, "a")), [0.0012, 0.00119, 0.00033], rtol=1e-6)
