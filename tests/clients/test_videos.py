"""Gymnasium's RecordVideo around both environments, with MoviePy."""

from pathlib import Path

import av
import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo, vector

pytest.importorskip("moviepy", reason="moviepy is not installed: nox -s clients")

pytestmark = [pytest.mark.pictures, pytest.mark.filterwarnings("default")]
SMALL = {"render_mode": "rgb_array", "width": 96, "height": 64, "overrides": ["env.sim.nthread=1"]}
ID = "wheelleg_exp:Wheelleg-Velocity-v0"


def film(path):
    """Return the images (n, h, w, 3) of a video and their rate."""
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]), rate


@pytest.fixture
def env(graphics):
    made = gymnasium.make(ID, **SMALL)
    yield made
    made.close()


def test_a_single_environment_is_filmed(env):
    env = RecordVideo(env, "videos", episode_trigger=lambda episode: True)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.zeros(6, np.float32))
    shown = env.render()
    env.close()
    pictures, rate = film(Path("videos/rl-video-episode-0.mp4"))
    assert (pictures.shape, rate) == ((21, 64, 96, 3), 60)
    assert np.abs(pictures[-1].astype(int) - shown).mean() < 6  # up to the losses of the codec


def test_a_batch_is_filmed_side_by_side(env):
    envs = gymnasium.make_vec(ID, num_envs=2, autoreset_mode="next_step", **SMALL)
    options = {"video_aspect_ratio": (3, 1), "step_trigger": lambda step: step == 0, "video_length": 10}
    envs = vector.RecordVideo(envs, "videos", **options)
    envs.reset(seed=0)
    for _ in range(12):
        envs.step(np.zeros((2, 6), np.float32))
    envs.close()
    pictures, _ = film(next(Path("videos").glob("*.mp4")))
    assert pictures.shape[2] * pictures.shape[1] == 2 * 64 * 96
    assert len(pictures) >= 10
