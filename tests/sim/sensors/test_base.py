import pytest
import torch
from managers.spies import Altimeter

from sim.small_envs import run
from wheelleg_exp.sim.sensors import SensorBase

pytestmark = pytest.mark.usefixtures("allow_test_terms")


def _env(start_env, **settings):
    env = start_env(scene={"sensors": {"height": {"_target_": "managers.spies.Altimeter", **settings}}})
    return env, env.scene["height"]


def test_it_measures_after_every_physics_step_and_is_refreshed_after_resets(start_env):
    env, sensor = _env(start_env)
    assert (list(env.scene), sensor.key) == (["robot", "terrain", "height"], "env.scene.sensors.height")
    assert sensor.key in env.streams.state_dict()["generators"]
    env.step(torch.zeros(4, 4))
    assert sensor.measured.tolist() == [2] * 4
    torch.testing.assert_close(sensor.height, env.scene.robot.data.root_pos_w[:, 2], atol=0.01, rtol=0)
    env.reset(env_ids=torch.tensor([2]))
    assert sensor.measured.tolist() == [2, 2, 0, 2]
    assert float(sensor.height[2]) == float(env.scene.robot.data.root_pos_w[2, 2])


def test_the_update_period_is_counted_in_each_environment(start_env):
    env, sensor = _env(start_env, update_period=0.03)
    counts = []
    for _ in range(4):
        run(env)
        counts.append(sensor.measured.tolist())
    assert [row[0] for row in counts] == [1, 2, 2, 3]
    env.reset(env_ids=torch.tensor([1]))
    env.step(torch.zeros(4, 4))
    assert sensor.measured.tolist() == [4, 1, 4, 4]


def test_a_long_update_period_ends_on_its_step_in_spite_of_float32_sums(start_env):
    env, sensor = _env(start_env, update_period=2.0)
    assert env.physics_dt == 0.01
    counts = []
    for _ in range(402):
        sensor.update()
        counts.append(int(sensor.measured[0]))
    assert [counts.index(n) for n in (1, 2, 3)] == [0, 200, 400]


class WithoutRefresh(Altimeter):
    reset, refresh = SensorBase.reset, SensorBase.refresh


@pytest.mark.parametrize("period", [0.0, 0.03])
def test_the_first_observation_of_an_episode_shows_a_new_measurement(make_env, period):
    sensors = {"height": {"_target_": "sim.sensors.test_base.WithoutRefresh", "update_period": period}}
    env = make_env(scene={"sensors": sensors})
    env.reset()
    for _ in range(4):
        env.step(torch.zeros(4, 4))
    before = env.scene["height"].height.clone()
    env.reset(env_ids=torch.tensor([2]))
    after, base = env.scene["height"].height, env.scene.robot.data.root_pos_w[:, 2]
    torch.testing.assert_close(after[2], base[2], atol=0.01, rtol=0)
    assert abs(float(before[2] - base[2])) > 0.02
    assert torch.equal(after[[0, 1, 3]], before[[0, 1, 3]])
