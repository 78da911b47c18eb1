"""The search of docs/examples/optuna: weak trials stop early, and the best run is the uninterrupted training."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from jobs.small import TINY, only_run, succeed

pytest.importorskip("optuna", reason="optuna is not installed: nox -s clients")
SEARCH = Path(__file__).resolve().parents[2] / "docs" / "examples" / "optuna" / "search.py"


@pytest.mark.train
def test_a_search_stops_weak_trials_and_its_best_run_is_the_training_alone():
    words, key = [*TINY, "agent.save_interval=1000"], "env.rewards.alive.weight"  # A larger weight gives more return.
    options = ["--trials", "4", "--iterations", "1", "2", "--figure", "Train/mean_reward"]
    command = [sys.executable, str(SEARCH), *words, f"{key}=choice(1,2,4,8)", *options]
    result = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)
    assert (result["params"], result["iterations"] < 8) == ({key: 8}, True)
    succeed("train", *words, f"{key}=8", "agent.max_iterations=2", "run.root=alone")
    assert Path(result["run"], "model_1.pt").read_bytes() == (only_run(Path("alone")) / "model_1.pt").read_bytes()
