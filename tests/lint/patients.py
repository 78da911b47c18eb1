"""A robot without defects, as MJCF, into which tests insert single defects."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from env.composed import composed

from wheelleg_exp.lint.diagnosis import OF_ROBOT, case_of_file
from wheelleg_exp.lint.physics_check import RULES
from wheelleg_exp.lint.rule import Case, Finding

# Hip 0.4 and knee -0.8 put the axle straight below the hip: thigh and shank are both 0.3 m long.
HIP, KNEE, LINK = 0.4, -0.8, 0.3
_LEG = """
      <body name="{s}_thigh" pos="0 {y} 0">
        <joint name="{s}_hip" axis="0 1 0" range="-1 1"/>
        <geom name="{s}_thigh" type="capsule" fromto="0 0 -0.05 0 0 -0.25" size="0.02" mass="0.1"/>
        <body name="{s}_shank" pos="0 0 -0.3">
          <joint name="{s}_knee" axis="0 1 0" range="-2 0"/>
          <geom name="{s}_shank" type="capsule" fromto="0 0 -0.05 0 0 -0.15" size="0.02" mass="0.1"/>
          <body name="{s}_wheel" pos="0 0 -0.3">
            <joint name="{s}_axle" axis="0 1 0"/>
            <inertial pos="0 0 0" mass="0.5" diaginertia="0.002 0.003 0.002"/>
            <geom name="{s}_wheel" type="cylinder" size="0.1 0.02" euler="1.5707963267948966 0 0"/>
          </body>
        </body>
      </body>"""
_DRIVES = """
    <position joint="{s}_hip" kp="200" kv="5" forcerange="-30 30"/>
    <position joint="{s}_knee" kp="200" kv="5" forcerange="-30 30"/>
    <velocity joint="{s}_axle" kv="0.5" forcerange="-5 5"/>"""
_SIDES = (("l", 0.2), ("r", -0.2))
HEALTHY = f"""
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="4" diaginertia="0.02 0.06 0.07"/>
      <geom name="trunk" type="box" size="0.2 0.1 0.05"/>{"".join(_LEG.format(s=s, y=y) for s, y in _SIDES)}
    </body>
  </worldbody>
  <actuator>{"".join(_DRIVES.format(s=s) for s, _ in _SIDES)}
  </actuator>
  <keyframe><key qpos="0 0 1 1 0 0 0 {HIP} {KNEE} 0 {HIP} {KNEE} 0"/></keyframe>
</mujoco>"""


def seeded(*changes: tuple[str, str], everywhere: bool = False) -> str:
    """Return the MJCF with replaced pieces of text."""
    text = HEALTHY
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new) if everywhere else text.replace(old, new, 1)
    return text


case_of = patch("wheelleg_exp.lint.diagnosis.compose", lambda words: composed(*words))(case_of_file)


def patient(folder: Path, text: str = HEALTHY, **sections: Any) -> Case:
    """Return the lint case of a robot, with replaced sections of ``env``."""
    file = folder / "robot.xml"
    file.write_text(text)
    case = case_of(file)
    return replace(case, config=replace(case.config, env=replace(case.env, **sections)))


def all_findings(case: Case) -> list[Finding]:
    """Return the findings of all rules about a robot."""
    return [finding for name in OF_ROBOT for finding in RULES[name](case)]
