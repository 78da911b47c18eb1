"""Each attribute of MuJoCo's USD schemas becomes an MJCF attribute, or the report names it with a reason."""

import pytest

from wheelleg_exp.errors import AssetError

from ..small_usd import applied, converted, hinge, link, write

# The table lists all attributes of mujoco-usd 4.0.0 (generatedSchema.usda) by schema and type, without "mjc:".
SCHEMAS = {
    "MjcSceneAPI": {
        "bool": """compiler:alignFree compiler:autoLimits compiler:balanceInertia compiler:fitAABB
            compiler:fuseStatic compiler:saveInertial compiler:useThread flag:actuation flag:autoreset flag:clampctrl
            flag:constraint flag:contact flag:damper flag:energy flag:equality flag:eulerdamp flag:filterparent
            flag:frictionloss flag:gravity flag:invdiscrete flag:island flag:limit flag:midphase flag:multiccd
            flag:fwdinv flag:nativeccd flag:override flag:refsafe flag:sensor flag:sleep flag:spring flag:warmstart""",
        "token": "compiler:angle compiler:inertiaFromGeom option:cone option:integrator option:jacobian option:solver",
        "double": """compiler:boundInertia compiler:boundMass compiler:setTotalMass option:ccd_tolerance
            option:density option:impratio option:ls_tolerance option:noslip_tolerance option:o_margin
            option:sleep_tolerance option:timestep option:tolerance option:viscosity""",
        "int": """compiler:inertiaGroupRange:max compiler:inertiaGroupRange:min option:ccd_iterations option:iterations
            option:ls_iterations option:noslip_iterations option:sdf_initpoints option:sdf_iterations""",
        "int[]": "option:actuatorgroupdisable",
        "double3": "option:magnetic option:wind",
        "double[]": "option:o_friction option:o_solimp option:o_solref",
    },
    "MjcSiteAPI": {"int": "group"},
    "MjcImageableAPI": {"int": "group"},
    "MjcCollisionAPI": {
        "int": "condim group priority",
        "double": "gap margin solmix",
        "bool": "shellinertia",
        "double[]": "solimp solref",
    },
    "MjcMeshCollisionAPI": {"token": "inertia", "int": "maxhullvert"},
    "MjcActuator": {
        "int": "actDim group",
        "bool": "actEarly jointInParent",
        "token": "actLimited biasType ctrlLimited dynType forceLimited gainType",
        "double": """actRange:max actRange:min crankLength ctrlRange:max ctrlRange:min forceRange:max forceRange:min
            inheritRange lengthRange:max lengthRange:min""",
        "double[]": "biasPrm dynPrm gainPrm gear",
    },
    "MjcKeyframe": {"double[]": "act ctrl mpos mquat qpos qvel"},
    "MjcJointAPI": {
        "token": "actuatorfrclimited",
        "double": """actuatorfrcrange:max actuatorfrcrange:min armature damping frictionloss margin ref springref
            stiffness""",
        "bool": "actuatorgravcomp",
        "int": "group",
        "double[]": "solimpfriction solimplimit solreffriction solreflimit springdamper",
    },
    "MjcMaterialAPI": {"double": "rollingfriction torsionalfriction"},
    "MjcEqualityAPI": {"double[]": "solimp solref"},
    "MjcEqualityWeldAPI": {"float": "torqueScale"},
    "MjcEqualityJointAPI": {"double": "coef0 coef1 coef2 coef3 coef4", "double[]": "solimp solref"},
    "MjcTendon": {
        "token": "actuatorfrclimited limited type",
        "double": """actuatorfrcrange:max actuatorfrcrange:min armature damping frictionloss margin range:max
            range:min stiffness width""",
        "int": "group",
        "double[]": "path:coef path:divisors solimpfriction solimplimit solreffriction solreflimit springlength",
        "int[]": "path:indices path:segments sideSites:indices",
        "color4f": "rgba",
    },
}
PLAIN = {"bool": "1", "int": "2", "float": "0.25", "double": "0.25", "double3": "(1, 2, 3)", "color4f": "(1, 0, 0, 1)"}
PLAIN |= {"token": '"auto"', "int[]": "[0, 0]", "double[]": "[0.5, 0.6]"}
SPECIAL = {"compiler:angle": '"radian"', "compiler:inertiaFromGeom": '"true"', "option:cone": '"elliptic"'}
SPECIAL |= {"option:integrator": '"implicit"', "option:jacobian": '"dense"', "option:solver": '"cg"'}
SPECIAL |= {"option:actuatorgroupdisable": "[3]", "biasType": '"affine"', "dynType": '"filter"', "gainType": '"affine"'}
SPECIAL |= {"actDim": "1", "jointInParent": "0", "inertia": '"exact"', "maxhullvert": "8", "condim": "4"}
SPECIAL |= {"type": '"spatial"', "path:divisors": "[2]", "path:indices": "[0, 1]", "sideSites:indices": "[-1, -1]"}
SPECIAL |= {"qpos": "[0, 0, 0, 1, 0, 0, 0, 0, 0]", "qvel": "[0, 0, 0, 0, 0, 0, 0, 0]", "mpos": "[]", "mquat": "[]"}
SPECIAL |= {"act": "[0]", "ctrl": "[0]"}
# A robot file should omit these attributes, or they repeat explicit masses, ranges, and radians.
NAMED = """option:timestep option:iterations option:ls_iterations option:tolerance option:ls_tolerance
    option:ccd_iterations option:ccd_tolerance option:sdf_iterations option:sdf_initpoints option:jacobian
    option:solver option:sleep_tolerance compiler:alignFree compiler:autoLimits compiler:fitAABB compiler:fuseStatic
    compiler:balanceInertia compiler:inertiaFromGeom compiler:inertiaGroupRange:max compiler:inertiaGroupRange:min
    compiler:saveInertial compiler:useThread shellinertia inertia path:coef"""


def everything(schema: str, *, but: tuple[str, ...] = ()) -> str:
    lines = []
    for kind, names in SCHEMAS[schema].items():
        for name in names.split():
            side = {"min": "-1", "max": "1"}.get(name.rpartition(":")[2])
            value = SPECIAL.get(name) or side or ("[0.5, 0.6, 0.1, 0.5, 2]" if "solimp" in name else PLAIN[kind])
            lines += [] if name in but else [f"{kind} mjc:{name} = {'2' if side and kind == 'int' else value}"]
    return "\n".join(lines)


def prim(kind: str, name: str, inside: str, apis: str = "") -> str:
    return f'def {kind} "{name}" {applied(apis)}\n{{\n{inside}\n}}\n'


MESH = """rel material:binding:physics = </bot/rubber>
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    int[] faceVertexCounts = [3, 3, 3, 3]
    int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    colliding = "PhysicsCollisionAPI PhysicsMeshCollisionAPI MjcCollisionAPI MjcMeshCollisionAPI MaterialBindingAPI"
    shapes = "".join(prim("Sphere", name, everything("MjcSiteAPI"), "MjcSiteAPI") for name in ("s1", "s2"))
    mesh = MESH + everything("MjcCollisionAPI") + "\n" + everything("MjcMeshCollisionAPI")
    shapes += prim("Mesh", "m", mesh, colliding)
    shapes += prim("Sphere", "v", everything("MjcImageableAPI"), "MjcImageableAPI")
    limits = "float physics:lowerLimit = -10\nfloat physics:upperLimit = 10\n"
    coupled = f"{limits}{everything('MjcJointAPI')}\n{everything('MjcEqualityJointAPI')}\nrel mjc:target = </bot/k>"
    welded = "uniform bool physics:excludeFromArticulation = 1\n" + everything("MjcEqualityAPI")
    welded += "\n" + everything("MjcEqualityWeldAPI")
    rubber = "float physics:dynamicFriction = 0.5\n" + everything("MjcMaterialAPI")
    parts = (
        link("a", inside=shapes) + link("b") + link("c"),
        hinge("j", "a", "b", apis="MjcJointAPI MjcEqualityJointAPI", text=coupled),
        hinge("k", "b", "c"),
        hinge("w", "a", "c", kind="Fixed", apis="MjcEqualityWeldAPI", text=welded),
        prim("MjcTendon", "t", "rel mjc:path = [</bot/a/s1>, </bot/a/s2>]\n" + everything("MjcTendon")),
        prim("MjcActuator", "n", "rel mjc:target = </bot/j>\n" + everything("MjcActuator", but=("crankLength",))),
        prim("MjcKeyframe", "key", everything("MjcKeyframe")),
        prim("Material", "rubber", rubber, "PhysicsMaterialAPI MjcMaterialAPI"),
    )
    scene = prim("PhysicsScene", "scene", everything("MjcSceneAPI"), "MjcSceneAPI")
    folder = tmp_path_factory.mktemp("everything")
    return converted(write(folder, "".join(parts), outside=scene))[1].report


def all_names() -> list[str]:
    names = {n for kinds in SCHEMAS.values() for text in kinds.values() for n in text.split()}
    return sorted(names - {"crankLength"})  # only for slider-cranks


@pytest.mark.parametrize("name", all_names())
def test_an_attribute_becomes_something_or_is_named_with_its_own_reason(report, name):
    mapped = {item.name for item in report.mapped}
    left = {item.name: item.reason for item in report.left_out}
    if name in NAMED.split():
        assert "not supported" not in left[f"mjc:{name}"]
    else:
        assert f"mjc:{name}" in mapped
        assert f"mjc:{name}" not in left


def test_nothing_is_warned_about(report):
    assert report.warnings == ()


@pytest.mark.parametrize(
    "text",
    [
        'uniform string mjc:option:actuatorgroupdisable = "x"',
        "double mjc:option:actuatorgroupdisable = inf",
        'string mjc:torsionalfriction = "x"',
        "double mjc:rollingfriction = inf",
    ],
)
def test_a_value_of_a_wrong_type_is_refused_with_its_prim(tmp_path, text):
    friction = "float physics:dynamicFriction = 0.5\n"
    rubber = prim("Material", "rubber", friction + text, "PhysicsMaterialAPI MjcMaterialAPI")
    ball = "rel material:binding:physics = </bot/rubber>"
    shape = prim("Sphere", "ball", ball, "PhysicsCollisionAPI MjcCollisionAPI MaterialBindingAPI")
    scene = prim("PhysicsScene", "scene", text, "MjcSceneAPI")
    with pytest.raises(AssetError) as caught:
        converted(write(tmp_path, link("a", inside=shape) + rubber, outside=scene))
    assert caught.value.key in ("/bot/rubber", "/scene")
    assert text.split()[-3] in str(caught.value)
