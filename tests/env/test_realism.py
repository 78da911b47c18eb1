"""The errors that ``realism`` adds to a task: in the config, in the readings of the robot, and in its physics."""

import math
import re

import pytest
import torch
from mdp.nodes import event
from sim.small_envs import ASSETS

from wheelleg_exp.config.checking.find_mistakes import find_mistakes
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.realism import with_realism, without_disturbances, without_realism
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.plain_data import require_plain
from wheelleg_exp.sim.delay import DelayBuffer
from wheelleg_exp.sim.options import read_env
from wheelleg_exp.state import same
from wheelleg_exp.state.old_layout import present_delay
from wheelleg_exp.terms.config_sections import plain_section

OBSERVATIONS = "wheelleg_exp.mdp.observations."
TASKS = ("stand", "walk", "velocity", "terrain")


def terms(*names):
    return {"policy": {"terms": {name: {"_target_": OBSERVATIONS + name} for name in names}}}


def readings(env, name):
    return env.observation_manager.terms("policy")[name].term(env)


@pytest.mark.parametrize("task", TASKS)
def test_every_stock_task_gets_the_errors_of_its_sensors_drives_and_body(task):
    env = read_env(compose([f"task={task}", "realism=full"]).config["env"])
    made = with_realism(env)
    assert list(made.events)[-len(env.realism.events) :] == env.realism.events
    assert ("push_robot" in env.events, "push_robot" in made.events) == (True, False)
    for name, node in made.observations["policy"].terms.items():
        is_sensor = name in ("base_ang_vel", "projected_gravity", "joint_pos_rel", "joint_vel_rel")
        assert (node.get("noise") is not None, node.get("delay")) == (is_sensor, [0, 1] if is_sensor else None)
    late = [0, 6] if task == "stand" else [0, 4]
    assert all((node["delay"], node["delay_jitter"]) == (late, 1) for node in made.actions.values())
    assert made.observations["critic"] == env.observations["critic"]


@pytest.mark.parametrize("variant", ["sensors", "full"])
def test_without_its_realism_a_task_is_the_ideal_task(variant):
    ideal = read_env(compose(["task=walk"]).config["env"])
    env = read_env(compose(["task=walk", f"realism={variant}", "~training"]).config["env"])
    assert without_realism(env) == ideal


@pytest.mark.parametrize("variant", ["none", "sensors", "full"])
def test_without_disturbances_nothing_pushes_the_robot_and_readings_are_exact(variant, tmp_path):
    """User-defined terms are judged by what they do: when they run, and whether they draw a force."""
    cfg = compose(["task=walk", f"realism={variant}", "env.num_envs=3", "event@env.events=[reset_base,kicks]"]).config[
        "env"
    ]
    cfg["events"]["poke"] = event(
        "apply_body_impulse", mode="step", force_range=[1, 2], duration_s=[1, 1], pause_s=[0, 0]
    )
    cfg["events"]["load"] = event("set_permanent_body_wrench", mode="reset", force_range=[1, 2], torque_range=[0, 0])
    address = {"_target_": "wheelleg_exp.mdp.curriculums.modify_term_cfg", "address": "events.poke.force_range"}
    cfg["curriculum"] = {**cfg["curriculum"], "harder": address}
    policy = cfg["observations"]["policy"]
    policy["enable_corruption"] = True
    policy["terms"]["projected_gravity"]["noise"] = {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "std": 9.0}
    given, before = read_env(cfg), read_env(cfg)
    calm = without_disturbances(given)
    assert given == before
    require_plain(plain_section(calm))  # The config of a play is saved as YAML.
    lost = {"kicks", "poke", "load"}
    assert calm.events.keys() == before.events.keys() - lost
    assert calm.curriculum.keys() == before.curriculum.keys() - {"harder"}
    made = with_realism(calm).observations["policy"].terms
    assert {name for name, node in made.items() if node.get("noise") is not None} == set()
    delays = [
        [node.get("delay") for node in with_realism(env).observations["policy"].terms.values()] for env in (calm, given)
    ]
    assert delays[0] == delays[1]  # A late reading is a property of the robot, and stays.


def test_noise_that_the_task_has_switched_off_stays_off():
    env = compose(["task=stand", "realism=sensors"]).config["env"]
    last_action = env["observations"]["policy"]["terms"]["last_action"]
    last_action["noise"] = {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise"}
    made = with_realism(read_env(env)).observations["policy"]
    assert (made.enable_corruption, made.terms["last_action"]["noise"]) == (True, None)
    env["observations"]["policy"]["enable_corruption"] = True
    made = with_realism(read_env(env)).observations["policy"]
    assert made.terms["last_action"]["noise"] == last_action["noise"]


def test_a_delay_with_jitter_never_returns_an_older_sample_than_before():
    buffer = DelayBuffer(torch.zeros(500, 1), (1, 2), torch.Generator().manual_seed(0), jitter=3)
    buffer.reset(torch.arange(500))
    shown = torch.stack([buffer.push(torch.full((500, 1), float(step)))[:, 0] for step in range(60)])
    assert (shown.diff(dim=0) >= 0).all()
    lag = (torch.arange(60.0).unsqueeze(1) - shown)[10:] - buffer.lag
    assert (float(lag.min()), float(lag.max())) == (0.0, 3.0)
    assert torch.equal(buffer.peek(torch.full((500, 1), 60.0)), buffer.peek(torch.full((500, 1), 60.0)))


def test_a_reset_of_a_delay_forgets_the_jitter_of_the_last_episode():
    buffer = DelayBuffer(torch.zeros(200, 1), (2, 4), torch.Generator().manual_seed(0), jitter=3)
    for step in range(12):
        buffer.push(torch.full((200, 1), float(step)))
    late = buffer._last_lag.clone()
    buffer.reset(torch.arange(0, 200, 2))
    assert torch.equal(buffer._last_lag[::2], buffer.lag[::2])
    assert torch.equal(buffer._last_lag[1::2], late[1::2])
    assert set(late.tolist()) == {0, 1, 2, 3}  # Before its first reset, a buffer has only the jitter.


def test_a_delay_continues_from_its_saved_share_of_the_range():
    def buffer():
        return DelayBuffer(torch.zeros(50, 1), (0, 4), torch.Generator().manual_seed(0), jitter=4)

    one, other = buffer(), buffer()
    one.share.fill_(0.25)
    old = {name.removeprefix("_"): value for name, value in one.state_dict().items()}
    other.load_state_dict(present_delay(old | {"share": 0.25}))  # one share for all environments
    assert same(one.state_dict(), other.state_dict())
    del old["share"], old["last_lag"]  # The oldest checkpoints have no jitter.
    other.load_state_dict(present_delay(old))
    assert torch.equal(other.share, torch.ones(50))
    other.load_state_dict(one.state_dict())
    for made in (one, other):
        made.reset(torch.arange(50))
    assert int(other.lag.max()) == 1
    for step in range(5):
        sample = torch.full((50, 1), float(step))
        assert torch.equal(one.push(sample), other.push(sample))


@pytest.mark.parametrize(
    ("override", "place"),
    [
        ("env.realism.events=[imu_erors]", "env.realism.events: there is no 'imu_erors'.*did you mean 'imu_errors'"),
        ("env.realism.replaces=[push_robt]", "there is no 'push_robt'.*did you mean 'push_robot'"),
        ("env.realism.groups=[polcy]", "env.realism.groups: there is no 'polcy'.*did you mean 'policy'"),
        ("+env.realism.sensors.base_ang_vell={}", "there is no 'base_ang_vell'.*did you mean 'base_ang_vel'"),
    ],
)
def test_a_misspelled_name_in_a_variant_is_a_mistake_and_a_removed_event_is_not(override, place):
    assert find_mistakes(["realism=full", "~env.events.kicks", "~env.curriculum.action_delay_levels"])[1] == []
    (error,) = find_mistakes(["realism=full", override])[1]
    assert re.search(place, str(error))


IMU = {"imu": {"_target_": "wheelleg_exp.sim.sensors.Imu", "body_name": "base"}}


def imu(make_env, pitch, bias, names=("base_ang_vel", "projected_gravity")):
    tilt = {"roll": [0.0, 0.0], "pitch": [pitch, pitch], "yaw": [0.0, 0.0]}
    errors = event("randomize_imu_errors", mode="reset", tilt_range=tilt, gyro_bias_range=[bias, bias])
    env = make_env(observations=terms(*names), events={"imu": errors}, scene={"sensors": IMU})
    env.reset()
    return env


def test_a_tilted_imu_with_a_bias_reads_the_true_motion_in_its_own_axes(make_env):
    env = imu(make_env, 0.3, 0.01)
    velocity = torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]).expand(4, 6)
    env.scene.robot.write_root_velocity_to_sim(velocity)
    cos, sin = math.cos(0.3), math.sin(0.3)
    rate = torch.tensor([1.0 * cos - 3.0 * sin, 2.0, 1.0 * sin + 3.0 * cos]) + 0.01
    torch.testing.assert_close(readings(env, "base_ang_vel"), rate.expand(4, 3))
    torch.testing.assert_close(readings(env, "projected_gravity"), torch.tensor([sin, 0.0, -cos]).expand(4, 3))
    torch.testing.assert_close(env.scene.robot.data.projected_gravity_b, torch.tensor([0.0, 0.0, -1.0]).expand(4, 3))
    env.scene.refresh()
    seen = env.scene["imu"].data
    torch.testing.assert_close(seen.ang_vel_b, rate.expand(4, 3))
    torch.testing.assert_close(seen.projected_gravity_b, torch.tensor([sin, 0.0, -cos]).expand(4, 3))


def test_a_floor_slope_tilts_gravity_and_the_imu_measures_the_slope(make_env):
    slope = event("randomize_floor_slope", mode="reset", slope_range=[0.2, 0.2])
    env = make_env(observations=terms("projected_gravity"), events={"slope": slope}, scene={"sensors": IMU})
    env.reset()
    gravity = env.scene.sim.expanded["opt.gravity"].float()
    torch.testing.assert_close(gravity.norm(dim=1), torch.full((4,), 9.81))
    torch.testing.assert_close(-gravity[:, 2] / 9.81, torch.full((4,), math.cos(0.2)))
    assert len(gravity[:, 0].unique()) == 4
    torch.testing.assert_close(readings(env, "projected_gravity"), gravity / 9.81)
    torch.testing.assert_close(env.scene["imu"].data.projected_gravity_b, gravity / 9.81)
    torch.testing.assert_close(env.scene["imu"].data.lin_acc_b, -gravity)


def test_a_kick_is_proportional_to_the_level_of_the_robot(make_env):
    kick = event("push_by_adding_velocity", mode="kick", velocity_range={"x": [2.0, 2.0]}, curriculum_name="levels")
    levels = {"_target_": "wheelleg_exp.mdp.curriculums.action_delay_levels", "num_episodes": 2}
    env = make_env(events={"kick": kick}, curriculum={"levels": levels})
    env.reset()
    env.curriculum_manager.get_term_cfg("levels").func.level[:] = torch.tensor([0.0, 0.25, 0.5, 1.0])
    env.apply_event("kick", torch.tensor([0, 1, 3]))
    assert env.scene.robot.data.root_vel_w[:, 0].tolist() == pytest.approx([0.0, 0.5, 0.0, 2.0], abs=1e-6)


def test_effort_limits_are_factors_on_the_configs_limits(make_env):
    limits = event("randomize_effort_limits", effort_limit_distribution_params=[0.5, 0.9], operation="scale")
    env = make_env(events={"limits": limits})
    share = env.scene.robot.data.joint_effort_limits / env.scene.robot.layout.effort_limits
    assert ((share >= 0.5) & (share <= 0.9)).all()
    assert len(share.unique()) == share.numel()
    places = [env.scene.model.actuator(name).id for name in env.scene.robot.joint_names]
    written = env.scene.sim.expanded["actuator_forcerange"][:, places, 1].float()
    torch.testing.assert_close(written, env.scene.robot.data.joint_effort_limits)


def test_exact_robots_have_true_readings_and_the_models_body_and_prompt_robots_act_at_once():
    words = ["env.realism.exact_share=0.5", "env.realism.actions.prompt_share=0.25", "env.num_envs=8"]
    config = compose(["task=walk", "realism=full", "env.sim.nthread=1", *words]).config["env"]
    env = ManagerBasedRLEnv(config, ASSETS / "legged.xml", 0)
    env.reset()
    for _ in range(3):
        seen = env.step(torch.randn(8, 6, generator=torch.Generator().manual_seed(1)))[0]["policy"]
    split = env.observation_manager.split("policy", seen)
    true = env.scene.robot.data.projected_gravity_b
    assert (split["projected_gravity"][:, -3:] == true).all(dim=1).tolist() == [True] * 4 + [False] * 4
    stiffness = env.scene.robot.data.joint_stiffness[:, 0]
    assert (len(stiffness[:4].unique()), len(stiffness.unique())) == (1, 5)
    delays = [*env.action_manager.delays.values(), env.observation_manager.terms("policy")["base_ang_vel"].delay]
    for delay, prompt in zip(delays, (2, 2, 4), strict=True):
        delay.share.fill_(1.0)
        longest = torch.zeros(8)
        for _ in range(50):
            delay.reset(torch.arange(8))
            longest = torch.maximum(longest, delay.lag)
        assert (longest > 0).tolist() == [False] * prompt + [True] * (8 - prompt)


def test_a_task_gets_its_training_with_the_variant_that_needs_it():
    def iterations(*words):
        return compose(["task=walk", *words]).config["agent"]["max_iterations"]

    assert (iterations(), iterations("realism=sensors"), iterations("realism=full", "~training")) == (160, 400, 160)
    assert (iterations("realism=full"), iterations("realism=full", "agent.max_iterations=5")) == (1000, 5)
    with pytest.raises(ConfigError, match="'walk_ful' is not an option"):
        iterations("training=walk_ful")
