"""Real robots have equal robot descriptions if read from URDF and from USD.

The corpus has USD files that ``urdf-usd-converter`` made from URDF files, and the numbers that MuJoCo read from these
URDF files. The tests write a URDF from the USD's robot description and convert the URDF.
"""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset import Conversion, RobotDescription, convert
from wheelleg_exp.asset.mjcf.mjcf_document import obj_text
from wheelleg_exp.asset.rigid_geometry import rotation_matrix
from wheelleg_exp.asset.robot_description import Body, Dof, Geom, Pose, Quat

from ..corpus import check_module, convert_asset, expectations
from ..small_urdf import at_zero, mass_matrix, tensor

pytestmark = pytest.mark.corpus


def rpy(rotation: Quat) -> str:
    """Return roll, pitch, and yaw of a rotation; the roll is 0 if the pitch is 90°."""
    m = rotation_matrix(rotation)
    pitch = math.atan2(-m[2, 0], math.hypot(m[0, 0], m[1, 0]))
    if math.hypot(m[0, 0], m[1, 0]) < 1e-9:
        return f"0 {pitch!r} {math.atan2(-m[0, 1], m[1, 1])!r}"
    return f"{math.atan2(m[2, 1], m[2, 2])!r} {pitch!r} {math.atan2(m[1, 0], m[0, 0])!r}"


def origin(pose: Pose) -> str:
    return f'<origin xyz="{" ".join(map(repr, pose.position))}" rpy="{rpy(pose.rotation)}"/>'


def shape(geom: Geom) -> str:
    size = [2 * value for value in geom.size]
    inner = {
        "box": lambda: f'<box size="{" ".join(map(repr, size))}"/>',
        "sphere": lambda: f'<sphere radius="{geom.size[0]!r}"/>',
        "cylinder": lambda: f'<cylinder radius="{geom.size[0]!r}" length="{size[1]!r}"/>',
        "capsule": lambda: f'<capsule radius="{geom.size[0]!r}" length="{size[1]!r}"/>',
        "mesh": lambda: f'<mesh filename="package://bot/{geom.mesh}.obj"/>',
    }[geom.kind]()
    tag = "collision" if geom.collides else "visual"
    return f"<{tag}>{origin(geom.pose)}<geometry>{inner}</geometry></{tag}>"


def link(body: Body) -> str:
    own = body.inertial
    frame = origin(Pose(own.center_of_mass, own.axes))
    moments = " ".join(f'{name}="{value!r}"' for name, value in zip(("ixx", "iyy", "izz"), own.moments, strict=True))
    inertial = f'{frame}<mass value="{own.mass!r}"/><inertia {moments} ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{body.name}"><inertial>{inertial}</inertial>{"".join(map(shape, body.geoms))}</link>\n'


def joint(body: Body) -> str:
    dof: Dof | None = body.dofs[0] if body.dofs else None
    kind, name, inside = "fixed", f"{body.name}_mount", ""
    if dof is not None:
        assert not any(dof.anchor)
        kind = "prismatic" if dof.kind == "slide" else "revolute" if dof.range else "continuous"
        name = dof.name
        limits = f'lower="{dof.range[0]!r}" upper="{dof.range[1]!r}" ' if dof.range else ""
        effort = dof.force_range[1] if dof.force_range else 0.0
        inside = f'<axis xyz="{" ".join(map(repr, dof.axis))}"/>'
        inside += f'<limit {limits}effort="{effort!r}" velocity="{dof.max_velocity or 0.0!r}"/>'
        inside += f'<dynamics damping="{dof.damping!r}" friction="{dof.frictionloss!r}"/>'
    ends = f'<parent link="{body.parent}"/><child link="{body.name}"/>'
    return f'<joint name="{name}" type="{kind}">{origin(body.pose)}{ends}{inside}</joint>\n'


def write_urdf(robot: RobotDescription, folder: Path) -> Path:
    links = "".join(link(body) for body in robot.bodies)
    joints = "".join(joint(body) for body in robot.bodies if body.parent)
    for mesh in robot.meshes:
        (folder / f"{mesh.name}.obj").write_text(obj_text(mesh))
    path = folder / "bot.urdf"
    path.write_text(f'<robot name="{robot.name}">\n{links}{joints}</robot>\n')
    return path


@pytest.fixture(scope="module", params=["upkie", "wf_tron2a_urdf"])
def both(request, corpus, tmp_path_factory) -> tuple[dict[str, Any], Conversion, Conversion]:
    expected = next(item for item in expectations(corpus) if item["name"] == request.param)
    assert expected["truth"] == "urdf"
    folder = tmp_path_factory.mktemp(request.param)
    from_usd = convert_asset(corpus, expected, folder / "usd.xml")
    return expected, from_usd, convert(write_urdf(from_usd.description, folder), folder / "urdf.xml")


def models(both: tuple[dict[str, Any], Conversion, Conversion]) -> list[mujoco.MjModel]:
    return [mujoco.MjModel.from_xml_path(str(item.output)) for item in both[1:]]


def names(model: mujoco.MjModel, kind: str, count: int) -> list[str]:
    return [getattr(model, kind)(index).name for index in range(count)]


def test_the_robot_from_urdf_agrees_with_the_corpus_in_every_aspect(corpus, both):
    check = check_module(corpus)
    expected, _, conversion = both
    found = check.Check(conversion.output, expected)
    states = found.aspects()
    assert {aspect: found.found[aspect] for aspect in check.CORE if states[aspect] == "no"} == {}
    assert found.agrees()


def test_bodies_and_joints_are_the_same(both):
    usd, urdf = models(both)
    assert names(urdf, "body", urdf.nbody) == names(usd, "body", usd.nbody)
    hinges = [name for name in names(usd, "joint", usd.njnt)]
    assert (names(urdf, "joint", urdf.njnt), list(urdf.body_parentid)) == (hinges, list(usd.body_parentid))
    for field in ("jnt_range", "jnt_limited", "jnt_actfrcrange", "jnt_axis", "dof_damping", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(urdf, field), getattr(usd, field), atol=1e-6, err_msg=field)
    assert both[2].report.velocity_limits == pytest.approx(both[1].report.velocity_limits)
    assert both[2].report.dof_order == both[1].report.dof_order


def test_masses_and_inertias_are_the_same(both):
    usd, urdf = models(both)
    np.testing.assert_allclose(urdf.body_mass, usd.body_mass, rtol=1e-9)
    for name in names(usd, "body", usd.nbody)[1:]:
        np.testing.assert_allclose(tensor(urdf, name), tensor(usd, name), atol=1e-6 * usd.body(name).inertia.max())


def test_poses_and_mass_matrices_are_the_same_at_any_coordinates(both):
    usd, urdf = models(both)
    rng = np.random.default_rng(7)
    for _ in range(3):
        data = [at_zero(model) for model in (usd, urdf)]
        bent = data[0].qpos.copy()
        bent[7:] = rng.uniform(-1, 1, len(bent) - 7)
        for model, item in zip((usd, urdf), data, strict=True):
            item.qpos[:] = bent
            mujoco.mj_forward(model, item)
        np.testing.assert_allclose(data[1].xpos, data[0].xpos, atol=1e-6)
        np.testing.assert_allclose(data[1].xmat, data[0].xmat, atol=1e-6)
        expected = mass_matrix(usd, data[0])
        np.testing.assert_allclose(mass_matrix(urdf, data[1]), expected, atol=1e-6 * np.abs(expected).max())


def test_colliders_and_visuals_are_the_same(both):
    usd, urdf = models(both)
    data = [at_zero(model) for model in (usd, urdf)]
    assert (list(urdf.geom_type), list(urdf.geom_bodyid)) == (list(usd.geom_type), list(usd.geom_bodyid))
    assert list(urdf.geom_contype) == list(usd.geom_contype)
    np.testing.assert_allclose(urdf.geom_size, usd.geom_size, atol=1e-6)
    np.testing.assert_allclose(data[1].geom_xpos, data[0].geom_xpos, atol=1e-6)
    np.testing.assert_allclose(data[1].geom_xmat, data[0].geom_xmat, atol=1e-5)
