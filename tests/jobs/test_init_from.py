"""A training that begins with another run's networks: what it takes over, what it refuses, what it keeps."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from jobs.small import TINY, Trained, copied, refused, succeed, wheelleg
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train

WORDS = ["task=stand", *TINY, "agent.save_interval=1", "recording.enabled=false", "agent.logger=null"]
KL = "+agent.initial_kl={weight: 1.0, except_while: velocity_commands}"
FROZEN = "agent.algorithm.learning_rate=1e-300"  # No float32 changes by so little.


def train(root: Path, source: object, *words: str) -> RunDirectory:
    succeed("train", *WORDS, f"init_from={source}", f"run.root={root}", *words)
    return RunDirectory.open(max((root / "stand").iterdir()), root)


@pytest.fixture(scope="module")
def begun(trained: Trained, tmp_path_factory) -> RunDirectory:
    """Train four iterations that start with the networks of a copied run, which is removed afterwards."""
    root = tmp_path_factory.mktemp("begun")
    source = copied(trained, root / "sources")
    run = train(root / "runs", source.path, KL, "agent.max_iterations=4")
    shutil.rmtree(source.path)
    return run


def networks(path: Path, *roles: str) -> dict[str, torch.Tensor]:
    state = checkpoint.load(path)
    return {f"{role}.{name}": value for role in roles for name, value in state[f"{role}_state_dict"].items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_the_first_rollout_has_the_networks_of_the_other_run_or_its_policy_alone(trained: Trained, tmp_path):
    frozen = ("agent.max_iterations=1", FROZEN, "agent.algorithm.schedule=fixed")
    last = trained.run.latest_checkpoint()
    run = train(tmp_path / "5", trained.run.path, *frozen, "seed=5", "agent.warm_start=1")  # init_from disables it
    assert same(networks(run.checkpoint(0), "actor", "critic"), networks(last, "actor", "critic"))
    run = train(tmp_path, trained.run.path, *frozen, "init_from_what=policy")
    drawn = train(tmp_path, "null", *frozen)
    assert same(networks(run.checkpoint(0), "actor"), networks(last, "actor"))
    assert same(networks(run.checkpoint(0), "critic"), networks(drawn.checkpoint(0), "critic"))


def test_a_new_observation_at_the_end_starts_without_influence(trained: Trained, tmp_path):
    frozen = ("agent.max_iterations=1", FROZEN, "agent.algorithm.schedule=fixed")
    run = train(tmp_path, trained.run.path, *frozen, f"+{TERMS}=[base_height]")
    old, new = (networks(path, "actor", "critic") for path in (trained.run.latest_checkpoint(), run.checkpoint(0)))
    first, added = "actor.mlp.0.weight", 5  # five control steps of one number
    assert torch.equal(new[first][:, :-added], old[first])
    assert (new[first][:, -added:] == 0.0).all()
    assert same({**new, first: old[first]}, old)
    words = (*WORDS, f"+{TERMS}=[base_height]", "init_from_what=learning", f"run.root={tmp_path}")
    assert "does not fit the converted networks" in refused("train", *words, f"init_from={trained.run.path}")


def test_check_finds_what_training_would_refuse_to_begin_with(trained: Trained):
    words = ["task=stand", *TINY, f"init_from={trained.run.path}"]
    assert wheelleg("check", *words).status == 0
    said = refused("check", *words, "agent.actor.activation=relu")
    assert [word for word in ("agent.actor.activation", "was trained with") if word not in said] == []
    said = wheelleg("check", *words, "init_from=nothing", "--json")
    assert (said.status, [mistake["key"] for mistake in json.loads(said.out)["mistakes"]]) == (2, ["init_from"])


def test_optimiser_and_iterations_start_from_scratch_unless_requested(begun, trained: Trained, tmp_path):
    learned = train(tmp_path, trained.run.path, "agent.max_iterations=1", "init_from_what=learning")
    steps = {}
    for what, path in (("networks", begun.checkpoint(0)), ("learning", learned.checkpoint(0))):
        state = checkpoint.load(path)
        steps[what] = float(state["optimizer_state_dict"]["state"][0]["step"])
        assert state["iter"] == 0
    before = float(checkpoint.load(trained.run.latest_checkpoint())["optimizer_state_dict"]["state"][0]["step"])
    assert steps == {"networks": before / 3, "learning": before + before / 3}  # The source run has three iterations.


def test_the_manifest_names_the_source_of_the_networks(begun: RunDirectory, trained: Trained):
    facts = begun.manifest().data["init_from"]
    last = trained.run.latest_checkpoint()
    assert (facts["run"], facts["task"], facts["checkpoint"]) == (trained.run.id, "stand", last.name)
    assert facts["sha256"] == sha256(last)
    kept = begun.asset / facts["kept"]
    assert facts["kept_sha256"] == sha256(kept)
    assert json.loads((begun.asset / "asset.json").read_text())["sources"][facts["kept"]] == sha256(kept)


def test_a_run_without_what_it_began_with_is_refused_by_name(begun: RunDirectory, tmp_path):
    path = tmp_path / "runs" / "stand" / begun.id
    shutil.copytree(begun.path, path)
    (path / "asset" / "networks" / "init_from.pt").unlink()
    said = refused("replay", path, "--root", tmp_path / "runs")
    assert "asset/networks/init_from.pt is missing" in said
    said = wheelleg("verify", path)
    assert said.status == 1
    assert "init_from.pt" in said.out


def test_it_resumes_to_the_bit_and_equal_networks_have_one_digest(begun, trained: Trained, tmp_path, monkeypatch):
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])
    source = copied(trained, tmp_path / "sources").path
    run = train(tmp_path, source.rename(source.with_name("another")), KL, "agent.max_iterations=2")
    assert run.manifest().data["init_from"]["kept_sha256"] == begun.manifest().data["init_from"]["kept_sha256"]
    said = succeed("resume", run.path, "agent.max_iterations=4")
    assert "not exact" not in said.out + said.err
    assert sha256(run.checkpoint(3)) == sha256(begun.checkpoint(3))
    said = refused("resume", run.path, "init_from=latest", "agent.max_iterations=5")
    assert "the run started with these networks" in said


TERMS = "observation@env.observations.policy.terms"
USUAL = "base_ang_vel,projected_gravity,velocity_commands,wheeled/joint_pos_rel,joint_vel_rel,last_action"


POLICY = "env.observations.policy"
MISTAKES = [
    (["init_from=nobody"], ["init_from: there is no run 'nobody'"]),
    (
        [f"{TERMS}=[base_height,{USUAL}]", "agent.actor.activation=relu", "action@env.actions=[wheel_vel,leg_pos]"],
        [
            f"{POLICY}.terms.base_height: is new, and",
            *("agent.actor.activation", "has elu, and this training has relu"),
            *("env.actions:", "in the order leg_pos, wheel_vel"),
        ],
    ),
    (
        [f"{POLICY}.terms.joint_pos_rel.asset_cfg.joint_names=['.*']"],
        ["[16, 135] there and [16, 145] here", f"note: {POLICY}.terms.joint_pos_rel.asset_cfg.joint_names was"],
    ),
]


@pytest.mark.parametrize(("words", "messages"), MISTAKES)
def test_settings_that_do_not_fit_the_networks_are_named(trained: Trained, tmp_path, words, messages):
    found = refused("train", *WORDS, f"init_from={trained.run.path}", f"run.root={tmp_path}", *words)
    assert [text for text in messages if text not in found] == []
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_can_be_named_and_a_changed_meaning_at_the_same_place_is_reported(trained, tmp_path):
    words = ["agent.max_iterations=1", "env.robot.profile=heavy"]
    words.append("++env.observations.policy.terms.base_ang_vel.scale=0.5")
    found = succeed("train", *WORDS, f"init_from={trained.run.checkpoint(0)}", f"run.root={tmp_path}", *words)
    assert "note: env.observations.policy.terms.base_ang_vel.scale was 0.25 and is 0.5" in found.err
    assert "note: env.robot.profile was article and is heavy" in found.err
    (path,) = tmp_path.glob("stand/*/manifest.json")
    assert json.loads(path.read_text())["init_from"]["checkpoint"] == "model_0.pt"


def test_a_checkpoint_that_somebody_has_changed_is_refused(trained: Trained, tmp_path):
    source = copied(trained, tmp_path / "sources")
    path = source.latest_checkpoint()
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert "init_from" in refused("train", *WORDS, f"init_from={source.path}", f"run.root={tmp_path / 'runs'}")
