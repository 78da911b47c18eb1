"""Runs repeat bit for bit."""

from collections.abc import Callable

import pytest

from repro import checks
from repro.runs import Lab, differences

pytestmark = [pytest.mark.repro, pytest.mark.train]


PROOFS = [checks.settings, checks.added_term, checks.splits, checks.killed, checks.snapshot]


@pytest.mark.parametrize("proof", PROOFS)
def test_nothing_changes_a_run(lab: Lab, proof: Callable[[Lab], list[str]]):
    assert proof(lab) == []


def test_a_replay_from_the_snapshot_is_the_same_run(lab: Lab):
    assert checks.replay(lab) == []


def test_a_flipped_bit_in_any_file_is_found(lab: Lab):
    assert checks.flipped_byte(lab) == []


def test_another_seed_is_another_run(lab: Lab):
    found = differences(lab.once(), lab.once("seed=1"))
    assert {f"model_{i}.pt" for i in range(4)} <= set(found)
