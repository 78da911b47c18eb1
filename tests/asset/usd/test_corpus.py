"""Each MuJoCo model of a real robot agrees with its USD file, and the report names all omitted physics."""

import re

import pytest
from pxr import Usd, UsdPhysics

from wheelleg_exp.asset import Conversion

from ..corpus import check_module, convert_asset

pytestmark = pytest.mark.corpus

# Prefixes of physics attributes in USD; the test does not use the converter's own list.
PROPERTY = re.compile(
    r"^(physics:|physx\w*:|drive:|state:|limit:|newton:|mjc:|urdf:|isaac:physics|omni:physx|collection:colliders)"
    r"|^material:binding:physics$"
)
SCHEMA = re.compile(r"^(Physics|Physx|Newton|Mjc)")  # of an applied schema, or a prim type


@pytest.fixture(scope="module")
def converted() -> dict[str, Conversion]:
    return {}


@pytest.fixture
def conversion(corpus, corpus_asset, converted, tmp_path_factory) -> Conversion:
    name = corpus_asset["name"]
    if name not in converted:
        converted[name] = convert_asset(corpus, corpus_asset, tmp_path_factory.mktemp(name) / f"{name}.xml")
    return converted[name]


def test_the_model_agrees_with_the_file_in_every_aspect(corpus, corpus_asset, conversion):
    check = check_module(corpus)
    found = check.Check(conversion.output, corpus_asset)
    states = found.aspects()
    assert {aspect: found.found[aspect] for aspect in check.CORE if states[aspect] == "no"} == {}
    assert found.agrees()


def prims(stage: Usd.Stage) -> list[Usd.Prim]:
    root = stage.GetDefaultPrim() or stage.GetPseudoRoot()
    inside = [prim for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()) if not prim.IsPseudoRoot()]
    scenes = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene) and prim not in inside]
    return inside + scenes


def test_every_authored_physics_is_mapped_or_named(corpus, corpus_asset, conversion):
    report = conversion.report
    mapped = {(item.path, item.name) for item in report.mapped}
    left = {(path, item.name) for item in report.left_out for path in item.values}
    stage = Usd.Stage.Open(str(corpus / corpus_asset["asset"]))
    authored = set()
    for prim in prims(stage):
        path = str(prim.GetPath())
        authored |= {(path, p.GetName()) for p in prim.GetAuthoredProperties() if PROPERTY.match(p.GetName())}
    assert authored, "the asset has physics"
    assert (authored - mapped - left, mapped & left) == (set(), set())


def test_every_physics_prim_and_schema_is_mapped_or_named(corpus, corpus_asset, conversion):
    report = conversion.report
    told = {item.path for item in report.mapped} | {path for item in report.left_out for path in item.values}
    stage = Usd.Stage.Open(str(corpus / corpus_asset["asset"]))
    silent = set()
    for prim in prims(stage):
        applied = [name for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas() if SCHEMA.match(name)]
        if (applied or SCHEMA.match(str(prim.GetTypeName()))) and str(prim.GetPath()) not in told:
            silent.add(f"{prim.GetPath()}: {prim.GetTypeName()} {applied}")
    assert silent == set()


def test_every_body_joint_and_shape_has_a_name_that_leads_back_to_the_file(corpus, corpus_asset, conversion):
    stage = Usd.Stage.Open(str(corpus / corpus_asset["asset"]))
    robot = conversion.description
    paths = [body.path for body in robot.bodies] + [dof.path for dof in robot.dofs]
    paths += [geom.path for body in robot.bodies for geom in body.geoms]
    assert all(stage.GetPrimAtPath(path) for path in paths)


def test_the_same_file_gives_the_same_bytes(corpus, corpus_asset, conversion, tmp_path):
    again = convert_asset(corpus, corpus_asset, tmp_path / conversion.output.name)
    folders = conversion.output.parent, again.output.parent
    files = [sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file()) for folder in folders]
    assert files[0] == files[1]
    assert all((folders[0] / name).read_bytes() == (folders[1] / name).read_bytes() for name in files[0])
    assert conversion.report.to_json() == again.report.to_json()
