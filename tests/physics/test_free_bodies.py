import math

import pytest
import torch
from sim.small_envs import ASSETS, init_state

from .worlds import STONE, G, at_reset, placed, seen, watch

MASS, INERTIA = 2.0, torch.tensor([0.02, 0.03, 0.04], dtype=torch.float64)
WEIGHTLESS = {"gravity": [0.0, 0.0, 0.0]}
TURNED = {"yaw": math.pi / 2}


def _to_world(vector):
    return torch.stack((-vector[1], vector[0], vector[2]))


def _mass(value, operation):
    return at_reset("randomize_rigid_body_mass", mass_distribution_params=[value, value], operation=operation)


def _wrench(force, torque):
    return at_reset("set_permanent_body_wrench", force_range=[force, force], torque_range=[torque, torque])


@pytest.mark.parametrize("integrator", ["euler", "implicitfast", "rk4"])
def test_a_thrown_stone_flies_along_the_parabola(world, integrator):
    dt, steps, decimation = 0.005, 50, 2
    thrown = {"x": 1.5, "y": -0.5, "z": 2.0}
    observations = seen("root_pos_w", "root_lin_vel_w", "base_lin_vel")
    events = {"throw": placed({"z": 1.0, "yaw": math.pi / 2}, thrown)}
    sim = {"integrator": integrator}
    shown = watch(world(STONE, dt, decimation=decimation, sim=sim, observations=observations, events=events), steps)
    n = decimation * torch.arange(steps + 1, dtype=torch.float64)
    t = n * dt
    # With semi-implicit Euler steps, a body falls g t dt / 2 further than with exact integration.
    fallen = G * t**2 / 2 if integrator == "rk4" else G * dt**2 * n * (n + 1) / 2
    place = torch.stack((thrown["x"] * t, thrown["y"] * t, 1.0 + thrown["z"] * t - fallen), dim=1)
    speed = torch.stack((0 * t + thrown["x"], 0 * t + thrown["y"], thrown["z"] - G * t), dim=1)
    torch.testing.assert_close(shown["root_pos_w"][:, 0], place, atol=2e-6, rtol=0)
    torch.testing.assert_close(shown["root_lin_vel_w"][:, 0], speed, atol=2e-6, rtol=0)
    in_link = torch.stack((speed[:, 1], -speed[:, 0], speed[:, 2]), dim=1)
    torch.testing.assert_close(shown["base_lin_vel"][:, 0], in_link, atol=2e-6, rtol=0)


def test_the_centre_of_mass_of_a_tumbling_stone_flies_along_the_parabola_too(world):
    def error(dt):
        events = {"throw": placed({}, {"x": 1.0, "roll": 3.0, "pitch": -2.0, "yaw": 4.0})}
        env = world(STONE, dt, observations=seen("root_lin_vel_w"), events=events)
        velocity = watch(env, round(0.2 / dt))["root_lin_vel_w"][-1, 0]
        return float((velocity - torch.tensor([1.0, 0.0, -0.2 * G], dtype=torch.float64)).norm())

    coarse, fine = error(0.004), error(0.002)
    assert fine < 0.02  # The speed of the centre of mass is 2.2 m/s.
    assert fine == pytest.approx(coarse / 2, rel=0.2)


def test_a_force_at_the_centre_of_mass_gives_momentum_along_the_links_axes_and_no_spin(world):
    force, dt, steps = 4.0, 0.005, 60
    observations = seen("root_lin_vel_w", "base_lin_vel", "root_ang_vel_w")
    events = {"turn": placed(TURNED), "push": _wrench(force, 0)}
    shown = watch(world(STONE, dt, decimation=2, sim=WEIGHTLESS, observations=observations, events=events), steps)
    t = torch.arange(steps + 1, dtype=torch.float64) * 2 * dt
    gained = torch.stack([force / MASS * t] * 3, dim=1)
    torch.testing.assert_close(shown["base_lin_vel"][:, 0], gained, atol=2e-6, rtol=0)
    torch.testing.assert_close(shown["root_lin_vel_w"][-1, 0], _to_world(gained[-1]), atol=2e-6, rtol=0)
    assert shown["root_ang_vel_w"].abs().max() < 1e-6


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_torque_gives_spin_about_each_of_the_links_axes_by_its_own_moment_of_inertia(world, factor):
    torque, dt = 0.5, 0.001  # A body does not precess in its first step from rest.
    observations = seen("base_ang_vel", "root_ang_vel_w", "root_lin_vel_w")
    # The event scales the inertia by the same factor as the mass.
    events = {"turn": placed(TURNED), "payload": _mass(factor, "scale"), "twist": _wrench(0, torque)}
    shown = watch(world(STONE, dt, sim=WEIGHTLESS, observations=observations, events=events), 1)
    spin = torque * dt / (factor * INERTIA)
    torch.testing.assert_close(shown["base_ang_vel"][1, 0], spin, atol=1e-8, rtol=1e-5)
    torch.testing.assert_close(shown["root_ang_vel_w"][1, 0], _to_world(spin), atol=1e-8, rtol=1e-5)
    assert shown["root_lin_vel_w"][1].abs().max() < 1e-7  # The centre of mass does not move.


@pytest.mark.parametrize("centre", [".05 -.02 .03", "0 0 0"])
def test_a_spinning_stone_turns_about_the_centre_of_mass_that_an_event_moved(world, centre):
    shift, spin, dt, steps = 0.04, 4.0, 0.001, 400
    events = {"moved": at_reset("randomize_rigid_body_com", com_range={"x": [shift, shift]})}
    events["spin"] = placed({"z": 1.0}, {"yaw": spin})
    stone = STONE.replace(".05 -.02 .03", centre)
    env = world(stone, dt, sim=WEIGHTLESS, observations=seen("root_pos_w"), events=events)
    place = watch(env, steps)["root_pos_w"][:, 0]
    x, y, _ = (float(part) for part in centre.split())
    angle = spin * dt * torch.arange(steps + 1, dtype=torch.float64)
    arm = complex(x + shift, y) * torch.exp(1j * angle)
    expected = torch.stack((x + shift - arm.real, y - arm.imag, torch.ones_like(angle)), dim=1)
    torch.testing.assert_close(place, expected, atol=5e-4, rtol=0)
    assert float(place[:, :2].norm(dim=1).max()) > shift


def test_a_push_gives_a_robot_with_loose_limbs_the_momentum_of_its_whole_mass_which_is_conserved(world):
    masses = {"base": 1.2, "left_arm": 0.2, "right_arm": 0.2, "left_wheel": 0.1, "right_wheel": 0.1}
    swinging = {"joint_pos": {".*_hip": 0.5}, "joint_vel": {"left_hip": 3.0, "right_hip": -2.0}}
    push = {"x": [0.5, 0.5], "y": [-0.2, -0.2], "z": [0.3, 0.3]}
    events = {"swing": at_reset("reset_scene_to_default"), "throw": placed(TURNED | {"z": 5.0}, {"x": 1.0})}
    events["push"] = at_reset("push_by_adding_velocity", velocity_range=push) | {"mode": "kick"}
    robot = {"init_state": init_state(0.0, {}) | swinging}
    env = world((ASSETS / "rover.xml").read_text(), 0.001, sim=WEIGHTLESS, robot=robot, events=events)
    env.reset()
    data = env.scene.robot.data
    mass = torch.tensor([masses[name] for name in data.body_names]).view(-1, 1)

    def momentum():
        return (mass * data.body_lin_vel_w[0]).sum(dim=0)

    before = momentum()
    env.apply_event("kick")
    pushed = momentum()
    torch.testing.assert_close(pushed - before, 1.8 * torch.tensor([0.5, -0.2, 0.3]), atol=1e-5, rtol=0)
    limb = data.body_lin_vel_w[0, -1].clone()
    for _ in range(250):
        env.step(torch.zeros(1, 0))
    torch.testing.assert_close(momentum(), pushed, atol=2e-3, rtol=0)
    assert (data.body_lin_vel_w[0, -1] - limb).norm() > 0.05  # The limbs have moved relative to the root.
