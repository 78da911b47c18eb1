import pytest
import torch

from sim.small_envs import env_config, env_of, physics_step, variant

ALL = torch.arange(4)
KP = torch.tensor([20.0, 20.0, 0.0, 0.0])
KD = torch.tensor([1.0, 1.0, 0.5, 0.5])
LIMIT = torch.tensor([4.0, 4.0, 2.0, 2.0])


def _hips(**changes):
    actuators = env_config()["robot"]["actuators"]
    actuators["hips"] |= changes
    return {"actuators": actuators}


def _env(start_env, model: str, **changes):
    actuators = env_config()["robot"]["actuators"]
    for group in actuators.values():
        group["_target_"] = f"wheelleg_exp.sim.actuators.{model}"
    return start_env(robot={"actuators": actuators}, **changes)


@pytest.mark.parametrize("model", ["ImplicitActuator", "IdealPDActuator"])
def test_the_reported_torque_is_the_clipped_pd_of_the_state_before_the_physics_step(start_env, model):
    env = _env(start_env, model)
    robot, data = env.scene.robot, env.scene.robot.data
    gen = torch.Generator().manual_seed(0)
    clipped = False
    for _ in range(30):
        robot.set_joint_position_target(torch.randn(4, 4, generator=gen) * 0.4, slice(None))
        robot.set_joint_velocity_target(torch.randn(4, 4, generator=gen) * 4, slice(None))
        robot.set_joint_effort_target(torch.randn(4, 4, generator=gen) * 0.2, slice(None))
        q, qd = data.joint_pos.clone(), data.joint_vel.clone()
        physics_step(env)
        expected = KP * (data.joint_pos_target - q) + KD * (data.joint_vel_target - qd) + data.joint_effort_target
        torch.testing.assert_close(data.computed_torque, expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(data.applied_torque, torch.clamp(expected, -LIMIT, LIMIT), atol=1e-4, rtol=1e-4)
        clipped |= bool((expected.abs() > LIMIT).any())
    assert clipped


def test_numbers_by_joint_reach_the_model_and_the_asset_has_the_missing_ones(tmp_path):
    path = variant(tmp_path, 'name="left_hip"', 'name="left_hip" frictionloss=".07" armature=".05"')
    friction = {"friction": {"right_hip": 0.2}, "viscous_friction": 0.3}
    hips = _hips(stiffness={"left_.*": 5.0, "right_.*": 7.0}, armature=None, **friction)
    model = env_of(path, env_config(robot=hips)).scene.model
    assert model.joint("left_hip").armature[0] == 0.05
    assert [model.actuator(f"{side}_hip").biasprm[1] for side in ("left", "right")] == [-5, -7]
    found = [(model.joint(name).frictionloss[0], model.joint(name).damping[0]) for name in ("left_hip", "right_hip")]
    assert found == [(0.07, 0.3), (0.2, 0.3)]


@pytest.fixture
def late(start_env, allow_test_terms):
    env = start_env(robot=_hips(_target_="managers.spies.Late"))
    return env, env.scene.robot.actuators["hips"]


def test_an_actuator_with_a_memory_has_a_stream_and_uses_its_memory(late):
    env, late = late
    named = env.streams.state_dict()["generators"]
    assert "env.robot.actuators.hips" in named
    assert "env.robot.actuators.axles" not in named
    assert late.dt == env.physics_dt
    robot, data, ids = env.scene.robot, env.scene.robot.data, late.joint_ids
    targets = [torch.full((4, 4), value) for value in (0.1, 0.2, 0.3, 0.4)]
    for step, target in enumerate(targets):
        robot.set_joint_position_target(target, slice(None))
        q, qd = data.joint_pos[:, ids].clone(), data.joint_vel[:, ids].clone()
        physics_step(env)
        expected = KP[ids] * ((targets[step - 2][:, ids] if step >= 2 else 0.0) + late.offset - q) - KD[ids] * qd
        torch.testing.assert_close(data.computed_torque[:, ids], expected, atol=1e-5, rtol=1e-5)
        robot.set_joint_position_target(torch.zeros(4, 4), slice(None))
        data.invalidate()
        torch.testing.assert_close(data.computed_torque[:, ids], expected, atol=1e-5, rtol=1e-5)


def test_an_actuators_memory_is_reset_with_its_environment(late):
    env, late = late
    env.step(torch.ones(4, 4))
    late.past.fill_(1.0)
    env.reset(env_ids=torch.tensor([1, 3]))
    assert late.past.flatten(1).sum(dim=1).tolist() == [4, 0, 4, 0]
