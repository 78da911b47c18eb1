"""Robots with round numbers, as MJCF texts."""

import math

RADIUS, TRACK, THIGH = 0.1, 0.4, 0.3  # m
WHEEL = f'<geom type="cylinder" size="{RADIUS} 0.02" euler="90 0 0"/>'


def mjcf(body: str, more: str = "", asset: str = "") -> str:
    """Return the MJCF of a floating box with the child bodies ``body`` and the top-level sections ``more``."""
    return f"""
<mujoco>
  <compiler angle="radian" eulerseq="xyz"/>
  <asset>{asset}</asset>
  <worldbody>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.2 0.1 0.05" mass="4"/>
      {body}
    </body>
  </worldbody>
  {more}
</mujoco>""".replace('euler="90 0 0"', f'euler="{math.pi / 2} 0 0"')


def leg(
    side: str, y: float, x: float = 0.0, *, hip: str = 'range="-1 1"', axle: str = 'axis="0 1 0"', wheel: str = WHEEL
) -> str:
    """Return a hip joint, a thigh that hangs straight down, a knee joint, a shank, and a wheel."""
    return f"""
      <body name="{side}_thigh" pos="{x} {y} 0">
        <joint name="{side}_hip" axis="0 1 0" {hip}/>
        <geom type="capsule" fromto="0 0 -0.05 0 0 -0.25" size="0.02" mass="0.5"/>
        <body name="{side}_shank" pos="0 0 -{THIGH}">
          <joint name="{side}_knee" axis="0 1 0" {hip}/>
          <geom type="capsule" fromto="0 0 -0.05 0 0 -0.15" size="0.02" mass="0.5"/>
          <body name="{side}_wheel" pos="0 0 -0.3">
            <joint name="{side}_axle" {axle}/>
            <inertial pos="0 0 0" mass="0.5" diaginertia="0.002 0.003 0.002"/>
            {wheel}
          </body>
        </body>
      </body>"""


def two_legged(**changes: str) -> str:
    """Return a robot with two wheeled legs; ``changes`` are arguments of ``leg``."""
    return mjcf(leg("l", TRACK / 2, **changes) + leg("r", -TRACK / 2, **changes))
