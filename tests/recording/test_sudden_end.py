import signal
import subprocess
import sys
import textwrap

import pytest
from forks import forking

from wheelleg_exp.recording.reading.recording_reader import Recording

pytestmark = pytest.mark.slow

_SCRIPT = """
    import json, os, signal, sys
    from pathlib import Path
    import torch
    from wheelleg_exp.config.composing.compose import compose
    from wheelleg_exp.env import ManagerBasedRLEnv
    from wheelleg_exp.jobs.rollout_files import EpisodeRecording
    from wheelleg_exp.jobs.train.training_recording import TrainingRecording
    from wheelleg_exp.config.schema import RecordingOptions
    from wheelleg_exp.run.run_directory import RunDirectory

    mjcf, root = Path(sys.argv[1]), Path(sys.argv[2])
    config = compose(["task=stand", "env.num_envs=2", "env.sim.nthread=1"]).config
    play_env, train_env = (ManagerBasedRLEnv(config["env"], mjcf, 0) for _ in range(2))
    play_env.reset(seed=0)
    train_env.reset(seed=0)
    options = {"enabled": True, "env_ids": [0], "interval": 50, "steps": 300, "max_mb": 200.0, "live": False}
    directory = RunDirectory.create(root, "stand", 0)
    about = {"name": "n", "about": {}, "documents": {}}
    play = EpisodeRecording(root / "play.rrd", play_env, RecordingOptions(**options), **about)
    train = TrainingRecording(directory, train_env, RecordingOptions(**options), {})
    print(directory.recording, flush=True)
    with torch.inference_mode(), play, train:
        for step in range(1, 155):
            play_env.step(torch.zeros(2, 6))
            train_env.step(torch.zeros(2, 6))
            if step % 24 == 0:
                train.write({"Train/mean_reward": float(step)}, step // 24 - 1)
        os.kill(os.getpid(), signal.SIGKILL)
"""
_STEPS = 154


@pytest.fixture(scope="module")
def killed(mjcf, tmp_path_factory) -> tuple[Recording, Recording]:
    root = tmp_path_factory.mktemp("killed")
    words = [sys.executable, "-c", textwrap.dedent(_SCRIPT), str(mjcf), str(root)]
    with forking():
        done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    return Recording(root / "play.rrd"), Recording(done.stdout.strip())


def test_a_kill_loses_less_than_a_second_of_a_play_and_the_current_iteration_of_a_training(killed):
    for recording, last in zip(killed, (None, 6 * 24), strict=True):
        steps = recording.table("base/height").column("step").to_pylist()
        assert steps == list(range(1, (last or len(steps)) + 1))
    assert 0 <= _STEPS - len(killed[0].table("base/height")) < 60
    for recording in killed:
        root = recording.properties["robot"]["root"]
        assert len(recording.table(f"world/{root}")) == len(recording.table("base/height"))
        assert recording.properties["wheelleg"]["format_version"] == 2
