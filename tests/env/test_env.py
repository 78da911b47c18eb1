"""Test steps, resets, episodes, and logs of the environment."""

import pytest
import torch
from managers import spies

from env.composed import term

STILL = torch.zeros(4, 4)
ALIVE = term("rewards.is_alive", weight=1.0)


@pytest.mark.parametrize(
    ("seconds", "dt", "decimation", "steps"),
    [
        (5.0, 1 / 120, 2, 300),
        (5.0, 0.008333333333333333, 2, 300),
        (1.0, 0.01, 2, 50),
        (1.0, 0.01, 3, 34),
        (0.1, 0.1, 3, 1),
    ],
)
def test_the_longest_episode_in_control_steps_is_rounded_up(make_env, seconds, dt, decimation, steps):
    env = make_env(episode_length_s=seconds, sim={"dt": dt}, decimation=decimation, num_envs=1)
    assert env.max_episode_length == steps


def test_an_episode_ends_at_its_longest_length_and_its_log_stays_until_the_next_reset(start_env):
    env = start_env(episode_length_s=0.06, rewards={"alive": ALIVE})
    found = []
    for _ in range(7):
        *_, ended, extras = env.step(STILL)
        found.append((ended.all().item(), extras["log_is_fresh"], extras["log"]))
    ends, fresh, logs = zip(*found, strict=True)
    assert ends == fresh == (False, False, True, False, False, True, False)
    assert logs[2] is logs[3] is logs[4]
    assert logs[4] is not logs[5]
    env.reset()
    assert (env.common_step_counter, env.episode_length_buf.tolist()) == (7, [0] * 4)


def test_a_step_returns_the_first_observation_of_the_next_episode(make_env):
    terms = {"q": term("observations.joint_pos"), "a": term("observations.last_action")}
    env = make_env(episode_length_s=0.04, observations={"policy": {"terms": terms, "history_length": 2}})
    start, _ = env.reset()
    env.keep_final_obs = True
    env.step(torch.ones(4, 4))
    obs, *_, extras = env.step(torch.ones(4, 4))
    assert torch.equal(obs["policy"], start["policy"])
    assert (extras["final_obs"]["policy"][:, 8:] == 1).all()
    assert not torch.equal(extras["final_obs"]["policy"], obs["policy"])
    *_, extras = env.step(torch.ones(4, 4))
    assert "final_obs" not in extras


def test_rewards_and_terminations_see_the_state_before_the_reset(start_env):
    spies.VALUES["tilt"] = lambda env: env.scene.robot.data.joint_pos[:, 0]
    reward = {"_target_": spies.HERE + "value", "key": "tilt", "weight": 1.0}
    env = start_env(episode_length_s=0.04, rewards={"r": reward})
    env.step(torch.ones(4, 4))
    reward = env.step(torch.ones(4, 4))[1]
    assert (reward > 0.2 * 0.02 + 1e-4).all()  # The reset sets the joint to its default of 0.2 rad.


def test_a_time_out_counts_as_alive(start_env):
    env = start_env(episode_length_s=0.02, rewards={"alive": ALIVE})
    _, reward, terminated, time_outs, _ = env.step(STILL)
    assert (time_outs.all().item(), terminated.any().item()) == (True, False)
    assert reward.tolist() == pytest.approx([0.02] * 4)


def test_the_log_has_isaac_labs_keys(make_env):
    spies.VALUES["k"] = 1.0
    command = term("commands.UniformVelocityCommand", resampling_time_range=[1.0, 1.0], ranges={})
    curriculum = {"c": {"_target_": spies.HERE + "state_of", "key": "k"}}
    _, extras = make_env(rewards={"alive": ALIVE}, commands={"v": command}, curriculum=curriculum).reset()
    wanted = {"Episode_Reward/alive", "Episode_Termination/time_out", "Curriculum/c"}
    wanted |= {f"Metrics/v/error_vel_{axis}" for axis in ("xy", "yaw")}
    assert wanted <= set(extras["log"])
    rest = {key.split("/")[0] for key in set(extras["log"]) - wanted}
    assert not rest & {"Episode_Reward", "Episode_Termination", "Metrics", "Curriculum"}


def test_a_reset_of_some_in_any_order_leaves_the_motion_of_the_other_environments(start_env):
    env = start_env()
    for _ in range(5):
        env.step(torch.ones(4, 4))
    before = env.scene.sim.state.clone()
    env.reset(env_ids=torch.tensor([2, 0]))
    assert env.episode_length_buf.tolist() == [0, 5, 0, 5]
    assert torch.equal(env.scene.sim.state[[1, 3]], before[[1, 3]])
    assert (env.scene.sim.state[[0, 2]] != before[[0, 2]]).any(dim=1).all()


def test_reset_to_starts_some_environments_in_a_given_state_with_a_fresh_history(make_env):
    terms = {"q": term("observations.joint_pos")}
    env = make_env(observations={"policy": {"terms": terms, "history_length": 3}})
    env.reset()
    for _ in range(5):
        env.step(torch.ones(4, 4))
    wanted = {name: value[:2].clone() for name, value in env.scene.get_state()["articulation"]["robot"].items()}
    for _ in range(5):
        env.step(-torch.ones(4, 4))
    others = env.scene.sim.view("qpos")[[1, 3]].clone()
    ids = torch.tensor([2, 0])
    observations, _ = env.reset_to({"articulation": {"robot": wanted}}, ids)
    found = env.scene.get_state()["articulation"]["robot"]
    for name, value in wanted.items():
        torch.testing.assert_close(found[name][ids], value)
    history = observations["policy"][ids].reshape(2, 3, -1)
    torch.testing.assert_close(history, wanted["joint_position"].unsqueeze(1).expand_as(history))
    assert env.episode_length_buf.tolist() == [0, 10, 0, 10]
    assert torch.equal(env.scene.sim.view("qpos")[[1, 3]], others)


def test_rewards_returned_do_not_change_later(start_env):
    env = start_env(rewards={"alive": ALIVE}, episode_length_s=0.04)
    _, reward, *_ = env.step(STILL)
    kept = reward.clone()
    env.reward_manager.get_term_cfg("alive").fields["weight"] = 7.0
    env.step(STILL)
    assert torch.equal(reward, kept)


def test_everything_of_a_reset_environment_is_fresh_in_the_observation(make_env):
    spies.VALUES["wheel_z"] = lambda env: env.scene.robot.data.body_pos_w[:, 3, 2]
    spies.VALUES["force"] = lambda env: env.scene["contact"].max_force_norm().amax(dim=1)
    terms = {k: {"_target_": spies.HERE + "column", "key": k} for k in ("wheel_z", "force")}
    env = make_env(episode_length_s=1.0, observations={"policy": {"terms": terms}})
    start, _ = env.reset()
    for _ in range(49):
        obs, *_ = env.step(STILL)
    assert (obs["policy"][:, 1] > 5).all()
    assert (obs["policy"][:, 0] < start["policy"][:, 0] - 0.05).all()
    obs, *_ = env.step(STILL)
    torch.testing.assert_close(obs["policy"], start["policy"])
    assert (obs["policy"][:, 1] == 0).all()


def test_a_broken_simulation_does_not_touch_its_neighbours(start_env, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    clean, broken = (start_env(terminations={"bad": term("terminations.non_finite_state")}) for _ in range(2))
    for env in (clean, broken):
        env.step(STILL)
    broken.scene.sim.view("qvel")[1, 3] = float("nan")
    for _ in range(5):
        clean.step(torch.ones(4, 4))
        broken.step(torch.ones(4, 4))
    others = [0, 2, 3]
    assert torch.equal(clean.scene.sim.state[others], broken.scene.sim.state[others])
    assert broken.scene.sim.state[1].isfinite().all()


def test_the_environment_runs_in_inference_mode_and_is_reset_outside(start_env):
    env = start_env(rewards={"alive": ALIVE}, episode_length_s=0.06)
    with torch.inference_mode():
        for _ in range(5):
            env.step(STILL)
    env.reset()
    env.step(STILL)
    assert (env.episode_length_buf == 1).all()
