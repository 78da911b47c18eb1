"""Runs repeat to the bit: small trainings by the command line, each in a process of its own."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.repro, pytest.mark.train]

SMALL = ["task=stand", "env.num_envs=32", "agent.max_iterations=3", "agent.save_interval=1", "recording.steps=20"]


def train(folder: Path, *overrides: str) -> dict[str, str]:
    """Train in a new process and return the sha256 of each checkpoint by name."""
    command = [sys.executable, "-m", "wheelleg_exp.cli.main", "train", *SMALL, f"run.root={folder}", *overrides]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*/*/model_*.pt")}


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return train(tmp_path_factory.mktemp("first"))


def test_the_same_command_twice_gives_the_same_checkpoints(first: dict[str, str], tmp_path: Path):
    assert set(first) == {"model_0.pt", "model_1.pt", "model_2.pt"}
    assert train(tmp_path) == first


def test_physics_threads_change_nothing(first: dict[str, str], tmp_path: Path):
    assert train(tmp_path, "env.sim.nthread=1") == first


def test_torch_threads_change_nothing(first: dict[str, str], tmp_path: Path):
    assert train(tmp_path, "agent.torch_threads=1") == first


def test_recording_changes_nothing(first: dict[str, str], tmp_path: Path):
    assert train(tmp_path, "recording.enabled=false") == first


def test_another_seed_gives_other_checkpoints(first: dict[str, str], tmp_path: Path):
    other = train(tmp_path, "seed=1")
    assert all(other[name] != first[name] for name in first)
