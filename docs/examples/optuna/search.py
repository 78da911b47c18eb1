"""Search for values of a task's keys with Optuna's sweeper: each trial is a training, and ends as an ordinary run."""

import json
import subprocess
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from wheelleg_exp.paths import configs_dir

FIGURE = "Train/mean_episode_length"  # of the results of a run; `Train/mean_reward` changes with the weights themselves
OWN = ["hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", "hydra.sweeper.n_jobs=1"]


@hydra.main(config_path=str(configs_dir()), config_name="train", version_base="1.3")
def trial(_: DictConfig) -> float:
    """Train with the trial's overrides in a process of its own, and return how well it went."""
    overrides = [word for word in HydraConfig.get().overrides.task if not word.startswith("hydra")]
    command = [sys.executable, "-m", "wheelleg_exp", "train", *overrides, "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode:  # a trial that fails is the worst, and the search goes on
        return 0.0
    told = json.loads(done.stdout)
    sys.stderr.write(f"{told['results'][FIGURE]} {told['run']} {' '.join(overrides)}\n")
    return float(told["results"][FIGURE])


if __name__ == "__main__":
    sys.argv[1:] = ["-m", *OWN, *(word for word in sys.argv[1:] if word not in ("-m", "--multirun"))]
    trial()
