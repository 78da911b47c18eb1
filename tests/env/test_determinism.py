"""One seed, one rollout, to the bit; and a state that continues in another environment."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

E = "wheelleg_exp.mdp.events."
O = "wheelleg_exp.mdp.observations."
R = "wheelleg_exp.mdp.rewards."
ROBOT = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot"}
NOISE = {
    "_target_": "wheelleg_exp.mdp.noise.NoiseModelWithAdditiveBias",
    "noise_cfg": {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "std": 0.05},
    "bias_noise_cfg": {"_target_": "wheelleg_exp.mdp.noise.UniformNoise", "operation": "abs"},
}
SECTIONS = {
    "num_envs": 6,
    "episode_length_s": 0.5,
    "events": {
        "material": {
            "_target_": E + "randomize_rigid_body_material",
            "mode": "startup",
            "static_friction_range": [0.2, 1.2],
            "dynamic_friction_range": [0.2, 1.0],
            "restitution_range": [0.0, 0.1],
            "num_buckets": 16,
        },
        "mass": {
            "_target_": E + "randomize_rigid_body_mass",
            "mode": "startup",
            "mass_distribution_params": [0.8, 1.3],
            "operation": "scale",
        },
        "com": {
            "_target_": E + "randomize_rigid_body_com",
            "mode": "reset",
            "com_range": {"x": [-0.01, 0.01], "z": [-0.01, 0.01]},
            "asset_cfg": ROBOT | {"body_names": ["base"]},
        },
        "wrench": {
            "_target_": E + "apply_external_force_torque",
            "mode": "reset",
            "force_range": [-1.0, 1.0],
            "torque_range": [-0.05, 0.05],
            "min_step_count_between_reset": 10,
            "asset_cfg": ROBOT | {"body_names": ["base", ".*_arm"]},
        },
        "place": {
            "_target_": E + "reset_root_state_uniform",
            "mode": "reset",
            "pose_range": {"x": [-0.1, 0.1], "yaw": [-3.0, 3.0]},
            "velocity_range": {"x": [-0.5, 0.5], "yaw": [-1.0, 1.0]},
        },
        "joints": {
            "_target_": E + "reset_joints_by_offset",
            "mode": "reset",
            "position_range": [-0.1, 0.1],
            "velocity_range": [-1.0, 1.0],
        },
        "push": {
            "_target_": E + "push_by_adding_velocity",
            "mode": "interval",
            "interval_range_s": [0.1, 0.3],
            "velocity_range": {"x": [-0.5, 0.5], "y": [-0.5, 0.5]},
        },
        "shove": {
            "_target_": E + "push_by_adding_velocity",
            "mode": "interval",
            "interval_range_s": [0.2, 0.4],
            "is_global_time": True,
            "velocity_range": {"z": [0.1, 0.2]},
        },
    },
    "commands": {
        "v": {
            "_target_": "wheelleg_exp.mdp.commands.UniformVelocityCommand",
            "resampling_time_range": [0.1, 0.4],
            "rel_standing_envs": 0.3,
            "heading_command": True,
            "rel_heading_envs": 0.5,
            "ranges": {
                "lin_vel_x": [-1.0, 1.0],
                "lin_vel_y": [0.0, 0.0],
                "ang_vel_z": [-1.0, 1.0],
                "heading": [-3.0, 3.0],
            },
        }
    },
    "observations": {
        "policy": {
            "enable_corruption": True,
            "history_length": 3,
            "terms": {
                "w": {"_target_": O + "base_ang_vel", "noise": NOISE},
                "g": {
                    "_target_": O + "projected_gravity",
                    "modifiers": [{"_target_": "wheelleg_exp.mdp.modifiers.DigitalFilter", "A": [-0.5], "B": [0.5]}],
                },
                "c": {"_target_": O + "generated_commands", "command_name": "v"},
                "q": {"_target_": O + "joint_pos", "noise": {"_target_": "wheelleg_exp.mdp.noise.UniformNoise"}},
                "t": {"_target_": O + "joint_effort"},
                "a": {"_target_": O + "last_action"},
            },
        }
    },
    "rewards": {
        "alive": {"_target_": R + "is_alive", "weight": 1.0},
        "track": {"_target_": R + "track_lin_vel_xy_exp", "weight": 2.0, "std": 0.5, "command_name": "v"},
        "acc": {"_target_": R + "joint_acc_l2", "weight": -1e-6},
        "contact": {
            "_target_": R + "contact_forces",
            "weight": -0.01,
            "threshold": 1.0,
            "sensor_cfg": {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "contact"},
        },
    },
    "terminations": {
        "time_out": {"_target_": "wheelleg_exp.mdp.terminations.time_out", "time_out": True},
        "tilt": {"_target_": "wheelleg_exp.mdp.terminations.bad_orientation", "limit_angle": 0.5},
    },
    "curriculum": {
        "c": {
            "_target_": "wheelleg_exp.mdp.curriculums.modify_reward_weight",
            "term_name": "track",
            "weight": 5.0,
            "num_steps": 40,
        }
    },
}


@pytest.fixture
def make(make_env):
    def build(seed=0, nthread=1, **changes):
        return make_env(seed=seed, **copy.deepcopy(SECTIONS) | {"sim": {"nthread": nthread}} | changes)

    return build


def _rollout(env, steps, start=0):
    """Return everything that each step gave."""
    out = []
    for k in range(start, start + steps):
        action = torch.randn(env.num_envs, 4, generator=torch.Generator().manual_seed(k))
        obs, reward, terminated, time_outs, extras = env.step(action)
        log = {key: float(value) for key, value in extras.get("log", {}).items()} if extras["log_is_fresh"] else {}
        out.append((obs["policy"], reward, terminated, time_outs, env.scene.sim.state.clone(), log))
    return out


def _same(first, second):
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        for i in range(5):
            assert torch.equal(a[i], b[i]), f"step {k}, item {i}"
        assert a[5] == b[5], f"step {k}, log"
    return True


def test_the_rollout_has_all_that_it_should_show(make):
    env = make()
    env.reset()
    rolled = _rollout(env, 60)
    assert sum(int(r[2].sum()) for r in rolled) > 0  # some fell
    assert sum(int(r[3].sum()) for r in rolled) > 0  # some ran out of time
    assert any("Curriculum/c" in r[5] for r in rolled)


@pytest.mark.parametrize("nthread", [1, 2])
def test_one_seed_gives_one_rollout_at_any_number_of_threads(make, nthread):
    first, second = make(), make(nthread=nthread)
    start, again = first.reset()[0]["policy"], second.reset()[0]["policy"]
    assert torch.equal(start, again)
    _same(_rollout(first, 60), _rollout(second, 60))


def test_another_seed_gives_another_rollout(make):
    first, second = make(seed=0), make(seed=1)
    assert not torch.equal(first.reset()[0]["policy"], second.reset()[0]["policy"])
    assert not torch.equal(_rollout(first, 2)[-1][4], _rollout(second, 2)[-1][4])


def test_a_reset_with_a_seed_starts_its_draws_anew(make):
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
    """In the middle of episodes, with everything that is random on, from another seed, through a file."""
    first = make()
    first.reset()
    _rollout(first, steps)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second = make(seed=123, nthread=nthread)
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(first.observation_manager.obs_buf["policy"], second.observation_manager.obs_buf["policy"])
    _same(_rollout(first, 40, steps), _rollout(second, 40, steps))


def test_a_saved_state_continues_after_the_other_environment_has_lived(make):
    first, second = make(), make(seed=3)
    first.reset()
    second.reset()
    _rollout(first, 12)
    _rollout(second, 31)
    second.load_state_dict(first.state_dict())
    _same(_rollout(first, 40, 12), _rollout(second, 40, 12))


def test_saving_changes_nothing_and_the_saved_state_stands_still(make):
    first, second = make(), make()
    first.reset()
    second.reset()
    _rollout(first, 5)
    _rollout(second, 5)
    saved = second.state_dict()
    kept = pickle.dumps(saved)
    _same(_rollout(first, 20, 5), _rollout(second, 20, 5))
    second_saved = pickle.loads(kept)
    assert _equal(saved, second_saved)


def _equal(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def test_a_loaded_environment_has_the_state_that_was_saved(make):
    first, second = make(), make(seed=8)
    first.reset()
    _rollout(first, 17)
    saved = first.state_dict()
    second.load_state_dict(saved)
    assert _equal(second.state_dict(), saved)


def test_looking_at_things_changes_no_trajectory(make):
    plain, looked = make(), make()
    plain.reset()
    looked.reset()
    looked.keep_final_obs = True
    data = looked.scene.robot.data
    looked.observers.append(lambda: (data.body_lin_vel_w, data.body_pos_w, data.computed_torque))
    for k in range(30):
        looked.observation_manager.peek()
        looked.state_dict()
        looked.describe()
        _same(_rollout(plain, 1, k), _rollout(looked, 1, k))


def _without(make, section, name):
    sections = copy.deepcopy(SECTIONS[section])
    del sections[name]
    return make(**{section: sections})


@pytest.mark.parametrize(
    ("section", "name"), [("events", "shove"), ("events", "material"), ("rewards", "acc"), ("terminations", "time_out")]
)
def test_removing_a_term_changes_no_other_terms_draws(make, section, name):
    whole, less = make(), _without(make, section, name)
    whole.reset()
    less.reset()
    assert torch.equal(whole.command_manager.get_command("v"), less.command_manager.get_command("v"))
    assert torch.equal(whole.scene.robot.data.joint_pos, less.scene.robot.data.joint_pos)
    assert torch.equal(whole.scene.robot._wrench, less.scene.robot._wrench)
    assert torch.equal(whole.scene.robot.data.com_b, less.scene.robot.data.com_b)


@pytest.mark.parametrize("fields", [["material"], ["mass"], ["material", "mass"], []])
def test_model_fields_randomised_in_part_go_round_too(make, fields):
    """set_const after loading must not move what was never randomised."""
    events = {k: v for k, v in SECTIONS["events"].items() if k in (*fields, "place", "joints")}
    first, second = make(events=events), make(seed=2, events=events)
    first.reset()
    _rollout(first, 10)
    second.load_state_dict(first.state_dict())
    _same(_rollout(first, 30, 10), _rollout(second, 30, 10))
