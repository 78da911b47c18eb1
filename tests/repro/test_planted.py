"""Each proof fails when a planted term breaks its promise."""

import functools
from collections.abc import Callable

import pytest
import yaml

from repro import checks
from repro.runs import Lab, Refused
from wheelleg_exp.run import file_inventory

pytestmark = pytest.mark.train
usual, long = pytest.mark.repro, pytest.mark.full

Planter = Callable[..., Lab]


@pytest.mark.parametrize(
    ("proof", "term"),
    [
        pytest.param(checks.settings, "entropy", marks=usual),
        pytest.param(checks.torch_threads, "torch_threads", marks=long),
        pytest.param(checks.physics_threads, "physics_threads", marks=long),
        pytest.param(checks.recording, "observers", marks=long),
    ],
)
def test_a_proof_fails_when_its_cause_is_planted(planted: Planter, proof, term):
    assert "model_0.pt" in proof(planted(term))


@long
def test_another_term_shows_a_draw_from_a_foreign_stream_and_a_draw_from_the_global_generator_is_rejected(lab: Lab):
    assert any("actor_state_dict" in what for what in checks.added_term(lab, "planted.terms.borrowed_draw"))
    with pytest.raises(Refused, match="generator"):
        checks.added_term(lab, "planted.terms.global_draw")


@usual
def test_a_split_shows_state_that_is_not_saved(planted: Planter):
    found = checks.splits(planted("hidden_steps"), every=[[2]])
    assert "stopped after [2]: model_2.pt" in found
    assert "stopped after [2]: model_1.pt" not in found


@long
def test_kill_9_shows_state_that_is_not_saved(planted: Planter):
    assert "model_3.pt" in checks.killed(planted("hidden_steps"), lines=[2])


@long
def test_a_replay_shows_what_the_snapshot_does_not_hold(planted: Planter, tmp_path):
    outside = tmp_path / "outside.txt"
    outside.write_text("1.0")
    lab = planted("outside_file", PLANTED_FILE=str(outside))
    lab.once()
    outside.write_text("2.0")
    assert checks.replay(lab) != []


@usual
def test_a_changed_snapshot_is_not_what_the_source_composes_to(lab: Lab, tmp_path):
    run = checks.copy_of(lab.once(), tmp_path)
    params = run / "params" / "env.yaml"
    changed = yaml.safe_load(params.read_text())
    changed["rewards"]["base_height"]["weight"] *= 1.001
    params.write_text(yaml.safe_dump(changed, sort_keys=False))
    assert checks.snapshot_differences(run) == ["params: env.rewards.base_height.weight"]


@usual
def test_a_flipped_bit_reveals_digests_that_are_not_recomputed(lab: Lab, tmp_path, monkeypatch):
    monkeypatch.setattr(file_inventory, "sha256", functools.cache(file_inventory.sha256))
    other = Lab(tmp_path)
    other.take(lab.once())
    assert "environment.txt" in checks.flipped_byte(other)
