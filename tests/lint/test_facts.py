"""Compare the facts of a compiled robot with hand-computed bodies and published figures of the stock robot."""

import math
from dataclasses import replace
from typing import Any

import mujoco
import pytest
from sim.small_envs import ASSETS

from wheelleg_exp.anatomy.collider_shapes import lowest_point
from wheelleg_exp.anatomy.compiled_robot import RobotFacts, compiled_robot
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.lint.physics_check import examine
from wheelleg_exp.managers import SceneManager


def drive(names: str, kind: str = "ImplicitActuator", **gains: Any) -> dict[str, Any]:
    values = {"stiffness": 0.0, "damping": 1.0, "effort_limit": 3.0, "velocity_limit": 20.0, **gains}
    return {"_target_": f"wheelleg_exp.sim.actuators.{kind}", "joint_names_expr": [names], **values}


pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def facts() -> RobotFacts:
    env = dict(compose().config["env"])
    init = {"pos": [0, 0, 0.52], "rot": [1, 0, 0, 0], "joint_pos": {"hip": 0.0}, "joint_vel": {"hip": 0.5}}
    actuators = {"wheels": drive("left|right"), "hip": drive("hip", "IdealPDActuator", stiffness=5.0)}
    env["robot"] = {**env["robot"], "init_state": init, "joint_order": None, "actuators": actuators}
    env["sim"] = {**env["sim"], "gravity": [0.0, 0.0, -10.0]}
    env["scene"] = {**env["scene"], "sensors": {}}
    scene = SceneManager(env, ASSETS / "bar.xml", 1).scene
    return compiled_robot(scene.spec.compile(), scene.robot)[1]


def test_masses_heights_and_wheels(facts):
    assert (facts.mass, facts.wheels) == (pytest.approx(4.0, abs=1e-5), ("left", "right"))
    assert (facts.wheel_radius, facts.track) == (pytest.approx(0.1), pytest.approx(0.6))
    assert (facts.standing_height, facts.clearance) == (pytest.approx(0.5), pytest.approx(0.02))
    assert (facts.wheel_load, facts.top_speed) == (pytest.approx(20.0, abs=1e-4), pytest.approx(2.0))
    assert facts.friction == pytest.approx((0.9 + 0.5) / 2)  # MuJoCo averages the friction with the ground's 0.5.
    without = replace(facts, wheels=())  # The one foot carries the whole weight.
    assert (without.wheel_load, without.top_speed) == (pytest.approx(40.0, abs=1e-4), 0.0)


def test_a_joint_has_the_inertia_the_load_and_the_drive_of_its_link(facts):
    hip, left = facts.joints["hip"], facts.joints["left"]
    assert (hip.inertia, hip.armature) == (pytest.approx(0.002 + 1 * 0.1**2), pytest.approx(0.7))
    assert (hip.low, hip.high, hip.default_velocity, hip.limited) == (-1.0, 1.0, 0.5, True)
    assert (left.inertia, left.limited) == (pytest.approx(0.003), False)
    # In the air the wheel turns against the remaining robot, so the inertia is slightly below the wheel's 0.003 kg·m².
    assert 0.0029 < left.effective < 0.003
    # The level bob is held against its weight times its arm.
    assert (hip.hold, left.hold) == (pytest.approx(-1 * 10 * 0.1), pytest.approx(0.0, abs=1e-9))
    assert (hip.drive.group, hip.drive.stiffness, hip.drive.explicit) == ("hip", 5.0, True)
    drive = left.drive
    assert (drive.group, drive.damping, drive.effort, drive.velocity) == ("wheels", 1.0, 3.0, 20.0)
    assert (drive.explicit, facts.joints["fan"].drive) == (False, None)


def test_the_pendulum_over_the_axle(facts):
    balance = facts.balance
    # Above the axle are 2 kg at 0.4 m and 1 kg at (0.1, 0.2) m. The mass of the fan is negligible.
    assert balance.mass == pytest.approx(3.0, abs=1e-5)
    height = math.hypot(0.1, 2 * 0.4 + 0.2) / 3
    assert balance.height == pytest.approx(height, abs=1e-5)
    inertia = 0.03 + 2 * 0.4**2 + 0.002 + 1 * (0.1**2 + 0.2**2)
    assert balance.inertia == pytest.approx(inertia, abs=1e-5)
    drop = 3 * 10 * height
    assert balance.pendulum == pytest.approx(math.sqrt(drop / inertia), rel=1e-4)
    rolling = inertia + 2 * 3 * 0.1 * height + 3 * 0.1**2 + 2 * (0.5 * 0.1**2 + 0.003)
    assert balance.pole == pytest.approx(math.sqrt(drop / rolling), rel=1e-4)


def test_the_stock_robot_has_its_published_figures():
    found = examine(compose()).case.facts
    assert (found.mass, found.standing_height) == (pytest.approx(0.5), pytest.approx(0.06995, abs=1e-5))
    assert (found.clearance, found.wheel_radius) == (pytest.approx(0.015, abs=1e-4), pytest.approx(0.02))
    assert (found.track, found.balance.mass) == (pytest.approx(0.112), pytest.approx(0.38))
    assert found.balance.height == pytest.approx(0.0441, abs=1e-4)
    assert found.balance.inertia == pytest.approx(1.03e-3, rel=0.01)
    assert found.balance.pole == pytest.approx(9.25, abs=0.01)
    assert found.joints["l03"].inertia == pytest.approx(1.2e-5, rel=1e-3)
    # The knee carries half the robot's weight minus the wheel and half of the shank, at a lever of 42.5 mm · sin 53°.
    arm = 0.0425 * math.sin(1.885 - 0.9599)
    load = (0.25 - 0.06) * 9.81 * arm - 0.02 * 9.81 * arm / 2
    assert abs(found.joints["l02"].hold) == pytest.approx(load, rel=0.01)


SHAPES = {
    "sphere": ('type="sphere" size="0.2"', 0.2),
    "capsule, turned by 60 degrees": ('type="capsule" size="0.1 0.4" euler="60 0 0"', 0.1 + 0.4 * 0.5),
    "cylinder, turned by 60 degrees": (
        'type="cylinder" size="0.3 0.05" euler="60 0 0"', 0.3 * math.sqrt(3) / 2 + 0.05 * 0.5),
    "box on its edge": ('type="box" size="0.1 0.2 0.2" euler="45 0 0"', 0.2 * math.sqrt(2)),
    "ellipsoid on its side": ('type="ellipsoid" size="0.1 0.2 0.3" euler="90 0 0"', 0.2),
    "mesh": ('type="mesh" mesh="wedge"', 0.25),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_how_far_down_a_shape_reaches(name):
    text, reach = SHAPES[name]
    wedge = "0 0 -0.25  1 0 0  0 1 0  0 0 0.5"
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="wedge" vertex="{wedge}"/></asset><worldbody><body pos="0 0 1">'
        f'<freejoint/><geom {text}/><geom type="sphere" size="0.9" contype="0" conaffinity="0"/></body></worldbody>'
        "</mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert lowest_point(model, data, [1]) == pytest.approx(1 - reach, abs=1e-6)
