import math

import mujoco
import pytest
import torch
from sim.small_envs import PLANE

from wheelleg_exp.sim.batch_engine import BatchEngine

from .worlds import G, at_reset, depth_in_step, placed, seen, watch

# A block of 2 kg that does not tip, because it is only 4 cm high.
BLOCK = """
<mujoco model="block">
  <worldbody>
    <body name="block" pos="0 0 .02">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia=".01 .01 .02"/>
      <geom type="box" size=".1 .1 .02" friction=".3"/>
    </body>
  </worldbody>
</mujoco>
"""
ROBOT, GROUND = {"static": 0.9, "dynamic": 0.5}, {"static": 0.5, "dynamic": 0.3}
FRICTION = {"static": 0.7, "dynamic": 0.4}  # PhysX averages the robot's and the ground's friction.
SPEED, DT = 1.5, 0.002


def _block(world, source="static", slope=0.0, speed=SPEED):
    plane = {"static_friction": GROUND["static"], "dynamic_friction": GROUND["dynamic"], "restitution": 0.0}
    gravity = [G * math.sin(slope), 0.0, -G * math.cos(slope)]
    ranges = {f"{kind}_friction_range": [mu] * 2 for kind, mu in ROBOT.items()}
    material = at_reset("randomize_rigid_body_material", **ranges, restitution_range=[0.0, 0.0], num_buckets=1)
    return world(
        BLOCK,
        DT,
        decimation=5,
        sim={"gravity": gravity, "cone": "elliptic", "impratio": 10.0},
        scene={"terrain": {"_target_": PLANE, **plane}, "sensors": {}},
        robot={"friction_source": source},
        observations=seen("root_pos_w", "root_lin_vel_w"),
        events={"material": material, "slide": placed({"z": 0.02}, {"x": speed})},
    )


@pytest.mark.parametrize("source", ["static", "dynamic"])
def test_a_sliding_block_loses_mu_g_a_second_and_stops_after_its_braking_distance(world, source):
    mu = FRICTION[source]
    stop = SPEED / (mu * G)
    shown = watch(_block(world, source), math.ceil(1.5 * stop / (5 * DT)))
    place, velocity = shown["root_pos_w"][:, 0, 0], shown["root_lin_vel_w"][:, 0]
    t = torch.arange(len(velocity), dtype=torch.float64) * 5 * DT
    # MuJoCo's contacts make a sliding block hop by a millimetre. The ground's upward impulse is m (g t + v_z), and
    # the impulse of friction is mu times the upward impulse.
    expected = SPEED - mu * (G * t + velocity[:, 2])
    sliding = t < 0.7 * stop
    torch.testing.assert_close(velocity[sliding, 0], expected[sliding], atol=2e-3, rtol=0)
    assert (velocity[t > 1.2 * stop, 0].abs() < 0.02).all()
    assert float(velocity[-1, 0]) == pytest.approx(0.0, abs=2e-3)
    assert float(place[-1]) == pytest.approx(SPEED**2 / (2 * mu * G), rel=0.02)


@pytest.mark.parametrize("degrees", [20, 50])
def test_on_a_slope_the_block_stays_or_slides_by_the_angle_of_friction(world, degrees):
    slope, mu, steps = math.radians(degrees), FRICTION["static"], 40
    speed = watch(_block(world, slope=slope, speed=0.0), steps)["root_lin_vel_w"][-1, 0, 0]
    expected = max(0.0, G * (math.sin(slope) - mu * math.cos(slope))) * steps * 5 * DT
    assert float(speed) == pytest.approx(expected, rel=0.02, abs=5e-3)
    assert (expected > 0) == (degrees > math.degrees(math.atan(mu)))


FACE, STEP = 0.06, 0.012  # distance from the wheel's axle to a step, and the step's height, m
# A wheel of the stock robot, half of the robot's mass, and the drive of `robot=physical`. The carriage does not tilt.
CARRIAGE = """
<mujoco>
  <option timestep="0.008333333333333333" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <geom type="box" size=".5 2 .006" pos=".56 0 .006"/>
    <body name="carriage" pos="0 0 .02" euler="0 0 {yaw}">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass=".19" diaginertia=".001 .001 .001"/>
      <body name="wheel">
        <joint name="axle" axis="0 1 0" armature="0.0001"/>
        <inertial pos="0 0 0" mass=".06" diaginertia="6.72e-06 1.2e-05 6.72e-06"/>
        <geom type="cylinder" size=".02 .006" euler="90 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity joint="axle" kv="0.01" forcerange="-.1 .1"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("yaw", [0, 3, 10, 20, 35, 50, 65])
def test_a_driven_wheel_neither_sinks_into_the_edge_of_a_step_nor_climbs_it_slowly(yaw):
    """The deepest penetration is 3.6 mm, and 9.3 mm with the faulty cylinder contacts of MuJoCo 4.0.0."""
    speeds = torch.tensor([0.05, 0.15, 0.3, 0.45, 0.6, 0.8], dtype=torch.float64)
    model = mujoco.MjModel.from_xml_string(CARRIAGE.format(yaw=yaw))
    engine = BatchEngine(model, len(speeds), nthread=1)
    wheel = model.body("wheel").id
    centres, turned = engine.derived("xpos"), engine.derived("xmat")
    engine.view("qvel")[:, 0], engine.view("qvel")[:, 3] = speeds, speeds / 0.02
    engine.view("ctrl")[:, 0] = speeds / 0.02
    deepest, furthest = torch.zeros(len(speeds)), torch.zeros(len(speeds))
    for _ in range(150):
        engine.step()
        axes = turned[:, wheel].reshape(-1, 3, 3)[:, :, 1]
        deepest = deepest.maximum(depth_in_step(centres[:, wheel], axes, FACE, STEP))
        furthest = furthest.maximum(centres[:, wheel, 0])
    assert deepest.max() < 0.004
    assert (deepest[2:] > 0).all()  # The wheel reaches the step.
    # At rest, a friction coefficient of 1 lifts a wheel onto steps of r (1 - cos 45°) = 5.9 mm; the kinetic energy at
    # 0.15 m/s lifts it by 1.1 mm.
    assert (furthest[:2] < FACE).all()
