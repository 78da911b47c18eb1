import math

import pytest
import torch

from .worlds import PENDULUM, G, at_reset, mounted, seen, watch

MASS, LENGTH, OWN = 0.5, 0.3, 0.004
INERTIA = OWN + MASS * LENGTH**2
SLOW = 2 * math.pi * math.sqrt(INERTIA / (MASS * G * LENGTH))  # the period of a pendulum with a small amplitude, s

# A double pendulum of two masses with moments of inertia.
LIMBS = """<body name="upper">
  <joint name="shoulder" axis="0 1 0"/>
  <inertial pos="0 0 -.2" mass=".6" diaginertia=".005 .005 .005"/>
  <body name="lower" pos="0 0 -.4">
    <joint name="elbow" axis="0 1 0"/>
    <inertial pos="0 0 -.15" mass=".3" diaginertia=".002 .002 .002"/>
  </body>
</body>"""
DOUBLE = mounted("double", LIMBS)


def _lifted(low, high):
    return at_reset("reset_joints_by_offset", position_range=[low, high], velocity_range=[0.0, 0.0])


def _period(angle, step):
    falls = ((angle[:-1] > 0) & (angle[1:] <= 0)).nonzero().flatten()
    first, last = (float(i + angle[i] / (angle[i] - angle[i + 1])) * step for i in (falls[0], falls[-1]))
    return (last - first) / (len(falls) - 1)


def _exact_period(amplitude):
    a, b = 1.0, math.cos(amplitude / 2)
    for _ in range(8):
        a, b = (a + b) / 2, math.sqrt(a * b)
    return SLOW / a


def test_every_swing_takes_the_elliptic_integral_of_its_amplitude(world):
    events = {"lift": _lifted(0.2, 2.6)}
    env = world(PENDULUM, 0.002, "fixed", num_envs=8, decimation=5, observations=seen("joint_pos"), events=events)
    angles = watch(env, 480)["joint_pos"][..., 0].T
    exact = [_exact_period(float(angle[0])) for angle in angles]
    assert [_period(angle, 0.01) for angle in angles] == pytest.approx(exact, rel=5e-4)
    assert max(exact) > 1.3 * SLOW  # The period depends on the amplitude.


def _energy(angle, speed):
    (q, bend), (w, turn) = angle.unbind(-1), speed.unbind(-1)
    both = w + turn
    kinetic = (0.005 + 0.6 * 0.2**2 + 0.3 * 0.4**2) * w**2 / 2 + (0.002 + 0.3 * 0.15**2) * both**2 / 2
    kinetic += 0.3 * 0.4 * 0.15 * w * both * torch.cos(bend)
    lower = 0.4 * torch.cos(q) + 0.15 * torch.cos(q + bend)
    return kinetic - 0.6 * G * 0.2 * torch.cos(q) - 0.3 * G * lower


def _lost(world, dt, integrator):
    changes = {
        "decimation": round(0.008 / dt),
        "sim": {"integrator": integrator},
        "events": {"lift": _lifted(1.5, 1.5)},
    }
    shown = watch(world(DOUBLE, dt, "fixed", observations=seen("joint_pos", "joint_vel"), **changes), 75)
    energy = _energy(shown["joint_pos"][:, 0], shown["joint_vel"][:, 0])
    assert shown["joint_vel"].abs().max() > 5  # The pendulum moves.
    return float((energy - energy[0]).abs().max())


def test_the_energy_of_a_passive_robot_is_conserved_better_with_shorter_steps(world):
    coarse, middle, fine = (_lost(world, dt, "implicitfast") for dt in (0.002, 0.001, 0.0005))
    assert coarse < 0.12  # 3 J change between kinetic and potential energy.
    assert (middle, fine) == (pytest.approx(coarse / 2, rel=0.25), pytest.approx(coarse / 4, rel=0.25))


def test_runge_kutta_conserves_energy_to_rounding(world):
    assert _lost(world, 0.002, "rk4") < 2e-5
