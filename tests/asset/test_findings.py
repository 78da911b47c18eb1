"""Each kind of finding occurs for a robot file with that defect, and findings determine the verdict."""

import json

import pytest

from wheelleg_exp.asset import Conversion, Report
from wheelleg_exp.asset.conversion_report import KINDS, Finding, Verdict, is_placeholder, verdict_of
from wheelleg_exp.cli.main import main

from . import small_urdf as urdf
from . import small_usd as usd


def numbers(done: Conversion, kind: str) -> dict[str, dict[str, float]]:
    return {item.subject: item.numbers for item in done.report.findings if item.kind == kind}


def limits(kind: str, text: str) -> str:
    return urdf.pair(kind, f"<limit {text}/>")


IMPOSSIBLE = urdf.inertial(2, tensor="1 1 3 0 0 0")


@pytest.mark.parametrize(
    ("robot", "kind", "subject", "expected"),
    [
        (limits("continuous", 'lower="-1" upper="2"'), "limits_ignored", "j", {"lower": -1, "upper": 2}),
        (urdf.pair(), "no_limits", "j", {}),
        (limits("revolute", 'lower="1" upper="1"'), "no_limits", "j", {"lower": 1, "upper": 1}),
        (limits("continuous", 'effort="1000"'), "placeholder_effort", "j", {"value": 1000}),
        (limits("continuous", 'effort="0"'), "placeholder_effort", "j", {"value": 0}),
        (limits("continuous", 'velocity="2000"'), "placeholder_velocity", "j", {"value": 2000}),
        (urdf.pair(child=""), "no_inertial", "b", {"mass": 1}),
        (urdf.pair(child=urdf.inertial(0)), "no_inertial", "b", {"mass": 1}),
        (urdf.pair(child=urdf.inertial(2)), "no_inertia", "b", {"mass": 2, "computed": 0}),
        (urdf.pair(child=urdf.inertial(2) + urdf.BOX), "no_inertia", "b", {"mass": 2, "computed": 1}),
        (urdf.pair(child=urdf.inertial(2, tensor="1e-20 1e-20 1e-20 0 0 0")), "tiny_inertia", "b", {"mass": 2}),
        (urdf.pair(child=IMPOSSIBLE), "impossible_inertia", "b", {"a": 1, "b": 1, "c": 3, "cut_to": 2}),
        (urdf.link("z", urdf.BOX) + urdf.joint("k", "z", "a", "fixed") + urdf.pair(), "end_without_collider", "b", {}),
        (urdf.pair(), "no_colliders", "bot", {}),
    ],
)
def test_findings_of_a_urdf_have_kind_subject_and_numbers(tmp_path, robot, kind, subject, expected):
    _, done = urdf.made(tmp_path, robot)
    found = numbers(done, kind)[subject]
    assert {key: found[key] for key in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    "limit", ['lower="0" upper="0"', 'lower="-1e16" upper="1e16"', 'lower="-1"', 'effort="20" velocity="30"']
)
def test_a_wheel_that_means_no_limits_is_nothing_odd(tmp_path, limit):
    _, done = urdf.made(tmp_path, limits("continuous", limit))
    assert {item.kind for item in done.report.findings} == {"no_colliders"}


def test_a_missing_mesh_is_counted_by_its_use(tmp_path):
    mesh = '<{0}><geometry><mesh filename="gone.stl"/></geometry></{0}>'
    inside = mesh.format("visual") + mesh.format("collision") * 2
    _, done = urdf.made(tmp_path, urdf.link("a", inside + urdf.BOX))
    assert numbers(done, "mesh_not_found") == {"gone.stl": {"colliders": 2, "visuals": 1}}
    assert done.report.verdict.reasons == ("2 colliders are lost with their mesh files",)


def test_findings_of_a_usd_have_kind_subject_and_numbers(tmp_path):
    drive = "float drive:angular:physics:maxForce = 5000\n float drive:angular:physics:damping = 1"
    text = f"{drive}\n float physxJoint:maxJointVelocity = 1e6\n"
    text += "float physics:lowerLimit = 3\n float physics:upperLimit = 3"
    body = usd.link("a") + usd.link("b", "(1, 0, 0)", mass="float physics:mass = 2")
    body += usd.hinge("j", "a", "b", text=f"point3f physics:localPos0 = (1, 0, 0)\n {text}")
    _, done = usd.converted(usd.write(tmp_path, body))
    assert numbers(done, "placeholder_effort") == {"j": {"value": 5000}}
    assert numbers(done, "placeholder_velocity")["j"]["value"] == pytest.approx(17453.29)
    assert numbers(done, "no_limits") == {"j": {"lower": 3, "upper": 3}}
    assert numbers(done, "no_inertia") == {"b": {"mass": 2}}


def test_the_assumed_share_of_the_mass_is_that_of_what_the_file_does_not_weigh(tmp_path):
    robot = urdf.link("a", urdf.BOX) + urdf.link("b", inertial="") + urdf.link("frame", inertial="")
    robot += urdf.joint("j", "a", "b", "continuous") + urdf.joint("k", "a", "frame", "fixed")
    _, done = urdf.made(tmp_path, robot)
    assert numbers(done, "no_inertial") == {"b": {"mass": 1}, "frame": {"mass": 0}}
    totals = done.report.totals
    assert (totals["mass"], totals["assumed_mass"], totals["assumed_share"]) == (2, 1, 0.5)
    assert done.report.verdict.reasons == ("50% of the mass is assumed",)


WHEEL = '<collision><geometry><cylinder radius="{}" length="0.02"/></geometry></collision>'


@pytest.mark.parametrize(
    ("radius", "mass", "said"),
    [
        (0.1, 1, ""),
        (100, 1, "2 kg in 200 m: a cube of that size would weigh 2.5e-07 kg/m³"),
        (100, 1e6, "the robot is 200 m long"),
        (1e-4, 1, "2 kg in 0.02 m: a cube of that size would weigh 2.5e+05 kg/m³"),
        (0.1, 1e5, "2e+05 kg in 0.2 m: a cube of that size would weigh 2.5e+07 kg/m³"),
    ],
)
def test_a_size_that_no_robot_has_is_in_doubt(tmp_path, capsys, radius, mass, said):
    link = f'<inertial><mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    wheel = urdf.link("a", WHEEL.format(radius), link) + urdf.link("b", WHEEL.format(radius), link)
    source = urdf.write(tmp_path, wheel + urdf.joint("j", "a", "b", "continuous"))
    assert main(["convert", str(source), "-o", str(tmp_path / "out.xml")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert ("DOUBTFUL: no robot has this size and mass" in told) is bool(said)
    assert said in told


def test_verdicts(tmp_path):
    assert (verdict_of([], 0.0, 0).level, verdict_of([], 0.0, 1).level) == ("good", "check")
    assert verdict_of([], 0.05, 0) == Verdict("check", ("5.0% of the mass is assumed",))
    lost = Finding("limits_ignored", "j", "/j", {"lower": -1, "upper": 1})
    assert verdict_of([lost], 0.0, 1).reasons == ("1 joints lost the limits that the file writes",)
    assert [is_placeholder(value) for value in (0, 999, 1000, -2000)] == [True, False, True, True]


def test_findings_are_read_from_json_and_older_reports_have_no_findings(tmp_path):
    _, done = urdf.made(tmp_path, urdf.pair())
    text = done.report.to_json()
    data = json.loads(text)
    assert data["verdict"]["level"] == "doubtful"
    assert {item["kind"] for item in data["findings"]} <= set(KINDS)
    assert Report.from_json(text) == done.report
    for key in ("findings", "values", "authored", "verdict"):
        del data[key]
    assert Report.from_json(json.dumps(data)).findings == ()
