import pytest
import torch
from sim.small_envs import ACTUATORS

from .worlds import mounted, seen, term, watch

OWN, ARMATURE = 0.002, 0.003  # the wheel's moment of inertia and the armature, kg m^2
INERTIA = OWN + ARMATURE
DAMPING, WANTED = 0.05, 12.0  # N m s/rad, rad/s; the time constant is 0.1 s.

# The wheel's centre of mass is on its fixed axle.
ROLLER = """<body name="wheel">
  <joint name="axle" axis="0 1 0"/>
  <inertial pos="0 0 0" mass=".4" diaginertia=".001 .002 .001"/>
</body>"""
WHEEL = mounted("wheel", ROLLER)


@pytest.mark.parametrize("decimation", [1, 4])
@pytest.mark.parametrize(
    ("kind", "left"),
    [
        ("ImplicitActuator", lambda share: 1 / (1 + share)),  # MuJoCo integrates this drive implicitly.
        ("IdealPDActuator", lambda share: 1 - share),  # This drive uses the speed before each step.
    ],
)
def test_each_step_leaves_a_share_of_the_error(world, kind, left, decimation):
    dt, steps = 0.005, 60 // decimation
    drive = {"_target_": ACTUATORS + kind, "joint_names_expr": ["axle"], "stiffness": 0.0, "damping": DAMPING}
    drive |= {"effort_limit": 100.0, "velocity_limit": 50.0, "armature": ARMATURE}
    spin = term("actions", "JointVelocityAction", joint_names=["axle"], scale=WANTED / 2)
    sections = {"robot": {"actuators": {"one": drive}}, "actions": {"spin": spin}, "observations": seen("joint_vel")}
    env = world(WHEEL, dt, "fixed", decimation=decimation, **sections)
    share = DAMPING * dt / INERTIA
    n = decimation * torch.arange(steps + 1, dtype=torch.float64)
    expected = WANTED * (1 - left(share) ** n)
    speeds = watch(env, steps, action=2.0)["joint_vel"][:, 0, 0]
    torch.testing.assert_close(speeds, expected, atol=2e-5, rtol=0)
