"""Several processes train one policy: what they learn, what one run directory holds of all, and how they end."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch
from patience import wait_until

from jobs.ranks import SIZE, end, start
from jobs.small import TINY, cache_of, lines, manifest, only_run, refused, succeed, without_times
from wheelleg_exp.asset import convert_cached
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.paths import find_asset
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.ranks import Ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("forks")]

FEW = [*TINY, "env.num_envs=4", "agent.save_interval=1", "recording.enabled=false"]
# After one step of gradient descent, the change of the weights is a multiple of the gradient.
GRADIENT_STEP = (
    "optimizer=sgd schedule=fixed learning_rate=0.1 num_learning_epochs=1 num_mini_batches=1 max_grad_norm=1e9"
)
DESCENT = [*FEW, "agent.max_iterations=1", *(f"agent.algorithm.{word}" for word in GRADIENT_STEP.split())]
NORMALISED = ["agent.actor.obs_normalization=true", "agent.critic.obs_normalization=true"]
TRAIN = ["train", *FEW, *NORMALISED]
LONG = "agent.max_iterations=1000000"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Run in two ranks: a mistake, a training, one gradient step, a resume, a stop by ctrl-c, and a death."""
    folder = tmp_path_factory.mktemp("ranks")
    commands = [
        ["fork", "resume", "none", "--root", "parts"],
        [*TRAIN, "agent.max_iterations=1", "run.root=parts"],
        ["train", *DESCENT, "run.root=descent"],
        ["resume", "latest", "agent.max_iterations=2", "--root", "parts", "--json"],
        [*TRAIN, LONG, "run.root=long"],
        ["resume", "latest", LONG, "--root", "long"],
    ]
    first, other = start(commands, folder)

    def rows() -> int:
        return sum(path.read_text().count("\n") for path in folder.glob("long/stand/*/iterations.jsonl"))

    assert wait_until(lambda: rows() > 1 or first.poll() is not None)
    first.send_signal(signal.SIGINT)  # The second process gets no signal.
    run = only_run(folder / "long")
    assert wait_until(lambda: manifest(run)["status"] == "interrupted" or first.poll() is not None)
    stopped = rows()
    assert wait_until(lambda: rows() > stopped or first.poll() is not None)
    other.kill()
    found = end([first, other])
    assert [statuses for statuses, _, _ in found] == [[2, 0, 0, 0, 130, 3], [3, 0, 0, 0, 130]], found
    (folder / "said.json").write_text(json.dumps([stopped, *found]))
    return folder


def alone(rank: int, mjcf: Path) -> Trainer:
    """Return the trainer of one of two ranks, alone in this process."""
    config, ranks = compose(DESCENT).config, Ranks(rank)
    env = ManagerBasedRLEnv(config["env"], mjcf, ranks.seed(config["seed"]))
    return Trainer(RslRlVecEnv(env), read_agent(config["agent"]), config["seed"], ranks=ranks)


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {
        f"{role}.{name}": value.detach().clone()
        for role in ("actor", "critic")
        for name, value in getattr(trainer.algorithm, role).named_parameters()
    }


def _of(role: str, found: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name.removeprefix(f"{role}."): value for name, value in found.items() if name.startswith(f"{role}.")}


def test_the_gradient_is_the_mean_of_what_each_finds_alone(folder, tmp_path_factory):
    source = find_asset("wheelleg/wheelleg.usda")
    mjcf = convert_cached(source, cache_dir=cache_of(tmp_path_factory) / "assets").output
    found: list[dict[str, torch.Tensor]] = []
    begun: dict[str, torch.Tensor] = {}
    for rank in range(SIZE):
        trainer = alone(rank, mjcf)
        begun = begun or weights(trainer)
        for role in ("actor", "critic"):  # Both ranks start with the weights of rank 0.
            network = getattr(trainer.algorithm, role)
            network.load_state_dict({**network.state_dict(), **_of(role, begun)})
        list(trainer.learn(until=1))
        after = weights(trainer)
        found.append({name: after[name] - begun[name] for name in begun})
    saved = checkpoint.load(only_run(folder / "descent") / "model_0.pt")
    for name, before in begun.items():
        role, _, key = name.partition(".")
        moved = saved[f"{role}_state_dict"][key] - before
        mean = (found[0][name] + found[1][name]) / 2
        assert not torch.allclose(found[0][name], found[1][name], rtol=0.1)
        torch.testing.assert_close(moved, mean, rtol=1e-3, atol=2e-7)


def test_a_resumed_run_is_the_straight_one_to_the_bit(folder):
    straight, parts = only_run(folder / "long"), only_run(folder / "parts")
    for index in range(2):
        assert (straight / f"model_{index}.pt").read_bytes() == (parts / f"model_{index}.pt").read_bytes()
    assert [without_times(line) for line in lines(straight)[:2]] == [without_times(line) for line in lines(parts)]
    assert manifest(parts)["resumes"][0]["exact"] is True


def test_a_checkpoint_holds_the_environments_and_streams_of_each(folder):
    run = only_run(folder / "parts")
    state = checkpoint.load(run / "model_1.pt")
    (other,) = state["ranks"]
    assert set(other) == {"unsaved", "env", "log", "rng"}
    assert digests.of_state({"env": other["env"]}) != digests.of_state({"env": state["env"]})
    assert digests.of_state(state) == lines(run)[1]["digests"]
    tampered = {**state, "ranks": [{**other, "log": {**other["log"], "return": other["log"]["return"] + 1}}]}
    assert digests.of_state(tampered)["log"] != lines(run)[1]["digests"]["log"]


def test_the_manifest_names_the_processes_that_trained(folder):
    run = only_run(folder / "parts")
    facts = manifest(run)["ranks"]
    assert (facts["world_size"], facts["backend"], facts["devices"]) == (SIZE, "gloo", ["cpu", "cpu"])
    assert facts["seeds"][0] == manifest(run)["seeds"][0] == 0
    assert len(set(facts["seeds"])) == SIZE


def test_only_one_process_prints_and_writes(folder):
    _, first, other = json.loads((folder / "said.json").read_text())
    assert json.JSONDecoder().raw_decode(first[1], first[1].index("\n{") + 1)[0]["results"]["iterations"] == 2
    assert "there is no run 'none'" in first[2]
    assert other[1:] == ["", ""]
    assert not [path for path in only_run(folder / "descent").iterdir() if "rank" in path.name]
    succeed("verify", only_run(folder / "parts"))


REFUSED = {"resume": "was trained by 2 processes and cannot resume with one process"}
REFUSED["replay"] = "was trained by 2 processes, and a replay trains with one"


@pytest.mark.parametrize(("command", "message"), REFUSED.items())
def test_one_process_cannot_resume_or_replay_a_run_of_two(folder, command, message):
    run = only_run(folder / "parts")
    before = manifest(run)
    said = refused(command, run)
    assert ([word for word in (message, "torchrun") if word not in said], manifest(run)) == ([], before)


@pytest.mark.parametrize("words", [["-m", "seed=1,2"], ["pipeline=default"]])
def test_what_makes_several_runs_is_refused_under_torchrun(monkeypatch, words):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "torchrun has started 2 processes" in refused("train", *words)


def test_ctrl_c_stops_all_after_one_iteration_and_a_death_ends_the_others(folder):
    stopped, (_, _, err), _ = json.loads((folder / "said.json").read_text())
    assert "another process of the training has ended" in err.splitlines()[-1]
    run = only_run(folder / "long")
    facts = manifest(run)
    assert (run / f"model_{stopped - 1}.pt").is_file()
    resume = facts["resumes"][0]
    assert (facts["status"], resume["iteration"], resume["exact"]) == ("failed", stopped, True)
