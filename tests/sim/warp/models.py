import mujoco

from sim.small_envs import env_config
from wheelleg_exp.sim.options import SimOptions

XML = """
<mujoco><option timestep=".005" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" friction=".8"/>
    <body name="trunk" pos="0 0 .3"><freejoint/>
      <geom name="trunk" type="sphere" size=".1" mass="2" group="1"/>
      <body name="arm" pos="0 0 .1">
        <joint name="hinge" axis="0 1 0" range="-1 1" limited="true" armature=".01" damping=".05" frictionloss=".02"/>
        <geom name="arm" type="capsule" size=".03" fromto=".05 0 0 .25 0 0" mass=".3" group="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="m" joint="hinge" kp="4" kv=".1" forcerange="-3 3"/></actuator>
  <sensor>
    <contact name="trunk" body1="trunk" num="4" data="found force normal"/>
    <contact name="arm" body1="arm" num="4" data="found force normal"/>
  </sensor>
</mujoco>
"""


def model(xml: str = XML) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def options(device: str = "cpu", **changes) -> SimOptions:
    section = env_config(sim={"engine": "warp", "device": device, "dt": 0.005, **changes})["sim"]
    return SimOptions(**{**section, "gravity": tuple(section["gravity"])})
