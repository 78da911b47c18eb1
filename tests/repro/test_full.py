"""The long proofs: complete trainings and many kills. ``nox -s repro -- full`` runs them."""

import random

import pytest

from repro import checks
from repro.runs import Lab

pytestmark = [pytest.mark.full, pytest.mark.train]


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """Trainings of the whole stock task."""
    return Lab(tmp_path_factory.mktemp("full"), base=["task=stand", "agent.save_interval=10"])


def test_a_full_training_killed_five_times_is_the_uninterrupted_one(stand: Lab):
    lines = sorted(random.Random(1).sample(range(5, 105), 5))
    assert checks.killed(stand, lines, seed=1, longest_s=1.5) == []


@pytest.mark.parametrize("proof", [checks.torch_threads, checks.replay])
def test_a_full_training_repeats_with_other_threads_and_from_its_snapshot(stand: Lab, proof):
    assert proof(stand) == []


@pytest.mark.parametrize("seed", range(10))
def test_kills_at_many_moments(lab: Lab, seed: int):
    lines = random.Random(seed).choices(range(5), k=3)
    assert checks.killed(lab, lines, seed=100 + seed, longest_s=0.5) == []


def test_a_stop_after_any_iteration_changes_nothing(lab: Lab):
    assert checks.splits(lab, every=[[1], [3]]) == []


@pytest.mark.parametrize(
    "proof",
    [checks.two_processes, checks.torch_threads, checks.physics_threads, checks.recording, checks.tensorboard],
)
def test_a_single_setting_changes_nothing(lab: Lab, proof):
    assert proof(lab) == []
