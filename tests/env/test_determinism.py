"""Test that equal seeds and restored states give bit-identical rollouts."""

import copy
import pickle

import pytest
import torch

from env.composed import event, term

ROBOT = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot"}
NOISE = term(
    "noise.NoiseModelWithAdditiveBias",
    noise_cfg=term("noise.GaussianNoise", std=0.05),
    bias_noise_cfg=term("noise.UniformNoise", operation="abs"),
)
COM, ARMS = {"x": [-0.01, 0.01], "z": [-0.01, 0.01]}, ROBOT | {"body_names": ["base", ".*_arm"]}
FRICTION = {"static_friction_range": [0.2, 1.2], "dynamic_friction_range": [0.2, 1.0], "restitution_range": [0.0, 0.1]}
FORCES = {"force_range": [-1.0, 1.0], "torque_range": [-0.05, 0.05], "min_step_count_between_reset": 10}
START = {"pose_range": {"x": [-0.1, 0.1], "yaw": [-3.0, 3.0]}, "velocity_range": {"x": [-0.5, 0.5], "yaw": [-1.0, 1.0]}}
PUSH = {"interval_range_s": [0.1, 0.3], "velocity_range": {"x": [-0.5, 0.5], "y": [-0.5, 0.5]}}
SHOVE = {"interval_range_s": [0.2, 0.4], "is_global_time": True, "velocity_range": {"z": [0.1, 0.2]}}
RANGES = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-1.0, 1.0], "heading": [-3.0, 3.0]}
SHARES = {"rel_standing_envs": 0.3, "heading_command": True, "rel_heading_envs": 0.5}
CONTACT = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "contact"}
TERMS = {
    "w": term("observations.base_ang_vel", noise=NOISE),
    "g": term("observations.projected_gravity", modifiers=[term("modifiers.DigitalFilter", A=[-0.5], B=[0.5])]),
    "c": term("observations.generated_commands", command_name="v"),
    "q": term("observations.joint_pos", noise=term("noise.UniformNoise")),
    "t": term("observations.joint_effort"),
    "a": term("observations.last_action"),
}
SECTIONS = {
    "num_envs": 6,
    "episode_length_s": 0.5,
    "events": {
        "material": event("randomize_rigid_body_material", "startup", num_buckets=16, **FRICTION),
        "mass": event("randomize_rigid_body_mass", "startup", mass_distribution_params=[0.8, 1.3], operation="scale"),
        "com": event("randomize_rigid_body_com", "reset", com_range=COM, asset_cfg=ROBOT | {"body_names": ["base"]}),
        "wrench": event("apply_external_force_torque", "reset", asset_cfg=ARMS, **FORCES),
        "place": event("reset_root_state_uniform", "reset", **START),
        "joints": event("reset_joints_by_offset", "reset", position_range=[-0.1, 0.1], velocity_range=[-1.0, 1.0]),
        "push": event("push_by_adding_velocity", "interval", **PUSH),
        "shove": event("push_by_adding_velocity", "interval", **SHOVE),
    },
    "commands": {
        "v": term("commands.UniformVelocityCommand", resampling_time_range=[0.1, 0.4], ranges=RANGES, **SHARES)
    },
    "observations": {"policy": {"enable_corruption": True, "history_length": 3, "terms": TERMS}},
    "rewards": {
        "alive": term("rewards.is_alive", weight=1.0),
        "track": term("rewards.track_lin_vel_xy_exp", weight=2.0, std=0.5, command_name="v"),
        "acc": term("rewards.joint_acc_l2", weight=-1e-6),
        "contact": term("rewards.contact_forces", weight=-0.01, threshold=1.0, sensor_cfg=CONTACT),
    },
    "terminations": {
        "time_out": term("terminations.time_out", time_out=True),
        "tilt": term("terminations.bad_orientation", limit_angle=0.5),
    },
    "curriculum": {"c": term("curriculums.modify_reward_weight", term_name="track", weight=5.0, num_steps=40)},
}


@pytest.fixture
def make(make_env):
    def build(seed=0, nthread=1, **changes):
        return make_env(seed=seed, **copy.deepcopy(SECTIONS) | {"sim": {"nthread": nthread}} | changes)

    return build


def _rollout(env, steps, start=0):
    """Return the results of all steps."""
    out = []
    for k in range(start, start + steps):
        action = torch.randn(env.num_envs, 4, generator=torch.Generator().manual_seed(k))
        obs, reward, terminated, time_outs, extras = env.step(action)
        log = {key: float(value) for key, value in extras.get("log", {}).items()} if extras["log_is_fresh"] else {}
        out.append((obs["policy"], reward, terminated, time_outs, env.scene.sim.state.clone(), log))
    return out


def _lived(env, steps):
    env.reset()
    _rollout(env, steps)
    return env


def _same(first, second):
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        for i in range(5):
            assert torch.equal(a[i], b[i]), f"step {k}, item {i}"
        assert a[5] == b[5], f"step {k}, log"


@pytest.mark.parametrize("nthread", [1, 2])
def test_one_seed_gives_one_rollout_at_any_number_of_threads(make, nthread):
    first, second = make(), make(nthread=nthread)
    start, again = first.reset()[0]["policy"], second.reset()[0]["policy"]
    assert torch.equal(start, again)
    rolled = _rollout(first, 60)
    _same(rolled, _rollout(second, 60))
    # Some robots fell, some episodes reached the time limit, and the curriculum logged a value.
    assert [any(r[i].any() for r in rolled) for i in (2, 3)] == [True, True]
    assert any("Curriculum/c" in r[5] for r in rolled)


def test_another_seed_gives_another_rollout(make):
    first, second = make(seed=0), make(seed=1)
    assert not torch.equal(first.reset()[0]["policy"], second.reset()[0]["policy"])
    assert not torch.equal(_rollout(first, 2)[-1][4], _rollout(second, 2)[-1][4])


def test_a_reset_with_a_seed_restarts_its_draws(make):
    env = make()
    drawn = []
    for seed in (5, None, 5):
        env.reset(seed=seed)
        drawn.append((env.command_manager.get_command("v").clone(), env.scene.robot.data.joint_pos.clone()))
    for first, second, third in zip(*drawn, strict=True):
        assert torch.equal(first, third)
        assert not torch.equal(first, second)


@pytest.mark.parametrize("steps", [0, 1, 7, 45])
@pytest.mark.parametrize("nthread", [1, 2])
def test_a_saved_state_continues_to_the_bit_in_a_new_environment(make, steps, nthread, tmp_path):
    first = _lived(make(), steps)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second = make(seed=123, nthread=nthread)
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(first.observation_manager.obs_buf["policy"], second.observation_manager.obs_buf["policy"])
    _same(_rollout(first, 40, steps), _rollout(second, 40, steps))


def test_saving_changes_nothing_and_the_saved_state_is_constant(make):
    first, second = (_lived(make(), 5) for _ in range(2))
    saved = second.state_dict()
    kept = pickle.dumps(saved)
    _same(_rollout(first, 20, 5), _rollout(second, 20, 5))
    assert pickle.dumps(saved) == kept


def test_reading_values_changes_no_trajectory(make):
    plain, looked = (_lived(make(), 0) for _ in range(2))
    looked.keep_final_obs = True
    data = looked.scene.robot.data
    looked.observers.append(lambda: (data.body_lin_vel_w, data.body_pos_w, data.computed_torque))
    for k in range(30):
        looked.observation_manager.peek()
        looked.state_dict()
        looked.describe()
        _same(_rollout(plain, 1, k), _rollout(looked, 1, k))
