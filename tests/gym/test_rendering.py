"""``render_mode="rgb_array"``: what is drawn, and that drawing changes nothing."""

import subprocess

import gymnasium
import numpy as np
import pytest

from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.gym import ENV_ID
from wheelleg_exp.rendering import renderer

ONE_THREAD = ["env.sim.nthread=1"]
SIZE = {"width": 160, "height": 120}
STILL = np.zeros(6, np.float32)


def make(**options):
    return gymnasium.make(ENV_ID, overrides=ONE_THREAD, render_mode="rgb_array", **{**SIZE, **options})


def make_vec(**options):
    return gymnasium.make_vec(ENV_ID, num_envs=2, overrides=ONE_THREAD, **{**SIZE, **options})


@pytest.fixture(scope="module")
def graphics(_cache):
    env = make()
    env.reset(seed=0)
    try:
        env.render()
    except renderer.NoGraphics as error:
        pytest.skip(str(error))
    finally:
        env.close()


def robot(image):
    """Return the pixels (h, w) bool of the robot, which are darker or more colourful than floor and sky."""
    image = image.astype(int)
    return (image.max(axis=2) < 120) | (np.ptp(image, axis=2) > 60)


def near(a, b):
    """Return whether two images are equal up to the rounding of a graphics driver."""
    return np.abs(a.astype(int) - b).max() <= 4


@pytest.mark.pictures
def test_the_robot_stands_in_the_middle_and_fills_the_picture(graphics):
    env = make()
    env.reset(seed=0)
    image = env.render()
    env.close()
    assert (image.shape, image.dtype) == ((120, 160, 3), np.uint8)
    rows, columns = np.nonzero(robot(image))
    assert np.abs([np.median(columns) - 80, np.median(rows) - 60]).max() < 20
    assert 0.35 < max(np.ptp(rows) / 120, np.ptp(columns) / 160) < 0.95


@pytest.mark.pictures
def test_each_environment_is_drawn_in_its_own_state(graphics):
    env = make_vec(render_mode="rgb_array")
    env.reset(seed=0)
    qpos = env.unwrapped.env.scene.sim.view("qpos")
    qpos[1] = qpos[0]
    alike = env.render()
    assert near(alike[0], alike[1])
    qpos[1, 0] += 100.0  # the camera follows the robot
    qpos[1, 3:7] = qpos.new_tensor([0.0, 1.0, 0.0, 0.0])  # upside down
    first, second = env.render()
    env.close()
    assert near(first, alike[0])
    assert (robot(second) != robot(first)).mean() > 0.02
    assert abs(np.median(np.nonzero(robot(second))[1]) - 80) < 25


@pytest.mark.pictures
def test_drawing_changes_nothing(graphics):
    seen = []
    for mode in (None, "rgb_array"):
        env = make_vec(render_mode=mode)
        found = [env.reset(seed=1)[0]["critic"]]
        for k in range(5):
            action = np.random.default_rng(k).uniform(-1, 1, (2, 6)).astype(np.float32)
            found.append(env.step(action)[0]["critic"])
            assert (env.render() is None) == (mode is None)
        env.close()
        seen.append(np.stack(found))
    np.testing.assert_array_equal(*seen)


@pytest.mark.pictures
def test_closing_stops_the_process_that_draws(graphics, monkeypatch):
    started = []
    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(real(*a, **k)) or started[-1])
    for env in (make(), make_vec(render_mode="rgb_array")):
        env.reset(seed=0)
        env.render()
        env.close()
    assert [process.returncode for process in started] == [0, 0]


def test_the_rate_of_pictures_is_that_of_the_control_steps():
    env = make()
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 60}
    slow = gymnasium.make(ENV_ID, overrides=[*ONE_THREAD, "env.decimation=4"])
    assert slow.metadata["render_fps"] == 30
    assert slow.render_mode is None


def test_without_graphics_the_message_names_the_missing_package(monkeypatch):
    monkeypatch.setattr(renderer, "BACKENDS", ("glfw",))  # no display here
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    env = make()
    env.reset(seed=0)
    with pytest.raises(WheellegError, match="apt install libegl1"):
        env.render()
    env.step(STILL)  # the environment still works
    env.close()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        *(({"render_mode": mode}, "render_mode") for mode in ("rgb_aray", ["rgb_array"])),
        *(({"width": width}, "width") for width in (4, "a", 64.5)),
        ({"height": 0}, "height"),
    ],
)
def test_invalid_options_of_rendering_are_refused(options, key):
    with pytest.raises(ConfigError) as caught:
        make_vec(**options)
    assert caught.value.key == key
