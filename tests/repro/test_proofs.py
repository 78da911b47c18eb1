"""Runs repeat to the bit: one proof a line."""

from __future__ import annotations

import pytest

from repro import checks
from repro.runs import Lab, differences

pytestmark = [pytest.mark.repro, pytest.mark.train]


def test_two_processes_give_the_same_run(lab: Lab):
    assert checks.two_processes(lab) == []


def test_torch_threads_change_nothing(lab: Lab):
    assert checks.torch_threads(lab) == []


def test_physics_threads_change_nothing(lab: Lab):
    assert checks.physics_threads(lab) == []


def test_recording_changes_nothing(lab: Lab):
    assert checks.recording(lab) == []


def test_tensorboard_changes_nothing(lab: Lab):
    assert checks.tensorboard(lab) == []


def test_another_term_changes_no_other_draw(lab: Lab):
    assert checks.added_term(lab) == []


def test_any_split_into_stops_and_resumes_changes_nothing(lab: Lab):
    assert checks.splits(lab) == []


def test_kill_9_and_resume_changes_nothing(lab: Lab):
    assert checks.killed(lab) == []


def test_a_replay_from_the_snapshot_is_the_same_run(lab: Lab):
    assert checks.replay(lab) == []


def test_the_snapshot_is_what_the_source_composes_to(lab: Lab):
    assert checks.snapshot(lab) == []


def test_a_flipped_bit_in_any_file_is_found(lab: Lab):
    assert checks.flipped_byte(lab) == []


def test_another_seed_is_another_run(lab: Lab):
    found = differences(lab.once(), lab.once("seed=1"))
    assert {f"model_{i}.pt" for i in range(4)} <= set(found)
