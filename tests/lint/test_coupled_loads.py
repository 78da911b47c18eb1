"""The loads of drives on coupled joints, compared with a simulation that stands still on stiff drives."""

import math

import mujoco
import numpy as np
import pytest

from lint.patients import patient

HIP, THIGH, SHANK, HEIGHT, AHEAD, RADIUS = 0.06, 0.15, 0.2, 0.25, 0.03, 0.07
ROD = '<geom type="capsule" fromto="0 0 0 0 0 -{0}" size="0.01" mass="0.3" contype="0" conaffinity="0"/>'
LEG = f"""
  <body name="{{s}}_{{x}}_thigh" pos="{{hip}} {{y}} 0"><joint name="{{s}}_{{x}}_hip" axis="0 1 0"/>{ROD.format(THIGH)}
    <body name="{{s}}_{{x}}_shank" pos="0 0 -{THIGH}"><joint name="{{s}}_{{x}}_knee" axis="0 1 0"/>{ROD.format(SHANK)}
      <site name="{{s}}_{{x}}" pos="0 0 -{SHANK}"/>{{wheel}}</body></body>"""
WHEEL = f"""<body name="{{s}}_wheel" pos="0 {{out}} -{SHANK}"><joint name="{{s}}_axle" axis="0 1 0"/>
  <geom type="cylinder" size="{RADIUS} 0.015" euler="1.5707963267948966 0 0" mass="0.4" condim="1"/></body>"""
HARD = 'solref="0.004 1" solimp="0.9999 0.9999 0.001 0.5 2"'
FREE, GUIDED = "<freejoint/>", '<joint type="slide" axis="0 0 1"/>'
GROUND = '<geom type="plane" size="5 5 1" condim="1" solref="0.004 1"/>'


def bent(ahead: float, sign: float) -> tuple[float, float]:
    """Return the positions of hip and knee at which the wheel is ``ahead`` of the hip (law of cosines)."""
    reach = math.hypot(ahead, HEIGHT)
    knee = sign * (math.pi - math.acos((THIGH**2 + SHANK**2 - reach**2) / (2 * THIGH * SHANK)))
    return math.atan2(-ahead, HEIGHT) - math.atan2(SHANK * math.sin(knee), THIGH + SHANK * math.cos(knee)), knee


def robot(kind: str, drives: dict[str, float], base: str = FREE, ground: str = "") -> str:
    """Return a robot whose legs are closed loops of two thighs and two shanks, or thighs with knees that follow."""
    front, rear = bent(AHEAD - HIP, 1), bent(AHEAD + HIP, -1)
    legs, equality, actuators = "", "", ""
    for side, sign in (("l", 1), ("r", -1)):
        wheel = WHEEL.format(s=side, out=0.03 * sign)
        legs += LEG.format(s=side, x="f", hip=HIP, y=0.15 * sign, wheel=wheel)
        if kind == "loop":
            legs += LEG.format(s=side, x="b", hip=-HIP, y=0.15 * sign, wheel="")
            equality += f'<connect site1="{side}_f" site2="{side}_b" {HARD}/>'
        else:
            terms = f'polycoef="{front[1] + 1.5 * front[0] - 0.3 * front[0] ** 2} -1.5 0.3 0 0"'
            equality += f'<joint joint1="{side}_f_knee" joint2="{side}_f_hip" {terms} {HARD}/>'
        where = dict(zip(("f_hip", "f_knee", "b_hip"), (*front, rear[0]), strict=True))
        actuators += "".join(f'<position joint="{side}_{j}" kp="{kp}" kv="40"/>' for j, kp in drives.items())
    positions = [*front, 0.0, *(rear if kind == "loop" else ())] * 2
    root = f"0 0 {HEIGHT + RADIUS} 1 0 0 0" if base == FREE else f"{HEIGHT + RADIUS}"
    targets = [where[name] for name in drives] * 2
    key = f'<key qpos="{root} {" ".join(map(str, positions))}" ctrl="{" ".join(map(str, targets))}"/>'
    base += f'<geom type="box" size="0.1 0.1 0.04" mass="5" contype="0" conaffinity="0"/>{legs}'
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/>
      <worldbody>{ground}<body name="base">{base}</body></worldbody>
      <equality>{equality}</equality><actuator>{actuators}</actuator><keyframe>{key}</keyframe></mujoco>"""


CASES = [
    ("loop", {"f_hip": 3000, "b_hip": 3000}),
    ("loop", {"f_hip": 3000, "f_knee": 3000}),
    ("mimic", {"f_hip": 3000}),
    ("mimic", {"f_knee": 3000}),
    ("mimic", {"f_hip": 3000, "f_knee": 1000}),
]


@pytest.mark.parametrize(("kind", "drives"), CASES)
def test_drives_of_coupled_joints_hold_the_load_that_a_simulation_measures(tmp_path, kind, drives):
    joints = patient(tmp_path, robot(kind, drives)).facts.joints
    model = mujoco.MjModel.from_xml_string(robot(kind, drives, GUIDED, GROUND))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, 4000)
    assert np.abs(data.qvel).max() < 1e-6
    for name in drives:
        torque = float(data.qfrc_actuator[model.joint(f"l_{name}").dofadr[0]])
        assert abs(torque) > 0.1
        assert joints[f"l_{name}"].hold == pytest.approx(torque, rel=0.02), name
    passive = {"l_f_hip", "l_f_knee", "l_b_hip", "l_b_knee"} & set(joints) - {f"l_{name}" for name in drives}
    assert [joints[name].hold for name in passive] == pytest.approx([0.0] * len(passive), abs=1e-3)


@pytest.mark.parametrize(("kind", "drives"), CASES[:4])
def test_a_drive_accelerates_the_coupled_joints_too(tmp_path, kind, drives):
    joints = patient(tmp_path, robot(kind, drives)).facts.joints
    model = mujoco.MjModel.from_xml_string(robot(kind, drives))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    model.opt.gravity, model.opt.iterations, model.opt.tolerance = 0, 1000, 0
    for name in drives:
        dof = model.joint(f"l_{name}").dofadr[0]
        heavy = mujoco.MjModel.from_xml_string(robot(kind, drives))
        heavy.opt.disableflags, heavy.opt.gravity = model.opt.disableflags, 0
        heavy.opt.iterations, heavy.opt.tolerance = 1000, 0
        # Great inertias lock the base and all other joints with a drive.
        heavy.body_mass[1], heavy.body_inertia[1] = 1e6, 1e6
        others = [f"{side}_{other}" for side in "lr" for other in (*drives, "axle") if (side, other) != ("l", name)]
        heavy.dof_armature[[heavy.joint(other).dofadr[0] for other in others]] = 1e6
        mujoco.mj_setConst(heavy, mujoco.MjData(heavy))
        for machine, inertia in ((model, joints[f"l_{name}"].effective), (heavy, joints[f"l_{name}"].inertia)):
            data = mujoco.MjData(machine)
            mujoco.mj_resetDataKeyframe(machine, data, 0)
            data.qfrc_applied[dof] = 1.0
            mujoco.mj_forward(machine, data)
            assert inertia == pytest.approx(1 / data.qacc[dof], rel=2e-3), name
