"""Real robots have equal robot descriptions if read from URDF and from USD.

The corpus has USD files that ``urdf-usd-converter`` made from URDF files, and the numbers that MuJoCo read from these
URDF files. The tests write a URDF from the USD's robot description and convert the URDF.
"""

import math
from pathlib import Path
from typing import Any

import pytest

from wheelleg_exp.asset import Conversion, RobotDescription, convert
from wheelleg_exp.asset.mjcf.mjcf_document import obj_text
from wheelleg_exp.asset.rigid_geometry import rotation_matrix
from wheelleg_exp.asset.robot_description import Body, Dof, Geom, Pose, Quat

from ..corpus import check_module, convert_asset, expectations

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


def test_the_robot_from_urdf_agrees_with_the_corpus_in_every_aspect(corpus, both):
    check = check_module(corpus)
    expected, from_usd, conversion = both
    found = check.Check(conversion.output, expected)
    states = found.aspects()
    assert {aspect: found.found[aspect] for aspect in check.CORE if states[aspect] == "no"} == {}
    assert found.agrees()
    assert conversion.report.velocity_limits == pytest.approx(from_usd.report.velocity_limits)
    assert conversion.report.dof_order == from_usd.report.dof_order
