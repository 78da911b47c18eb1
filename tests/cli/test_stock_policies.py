import functools
import hashlib
import json
import re
import runpy
import shutil
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from jobs.small import wheelleg
from refused import refusal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.protocol import metric_names
from wheelleg_exp.files import read_yaml, sha256
from wheelleg_exp.jobs.evaluate_policy import evaluation_settings
from wheelleg_exp.jobs.saved_robot import saved_mjcf
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.rl.checkpoint import require_resumable
from wheelleg_exp.run import stock_policies
from wheelleg_exp.run.run_config import load_params, on_reference_engine
from wheelleg_exp.run.run_directory import RunDirectory

ROOT = Path(__file__).resolve().parents[2]
NAMES = stock_policies.stock_names()
QUICK = ["recording.enabled=false", "--json"]
FEW = {"get_up": ["env.events.reset_lying.num_poses=32"]}  # The drops to these poses take longer than the play.


@pytest.fixture
def copied_policies(own_folders, tmp_path, monkeypatch):
    """Make ``assets_dir`` return a copy of the shipped policies, which a test may change."""
    shutil.copytree(assets_dir() / "policies", tmp_path / "assets" / "policies")
    monkeypatch.setattr(stock_policies, "assets_dir", lambda: tmp_path / "assets")
    return tmp_path / "assets" / "policies"


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_policy_balances_eight_robots(own_folders, name):
    said = wheelleg("play", f"stock:{name}", "env.num_envs=8", "env.episode_length_s=5", *FEW.get(name, ()), *QUICK)
    assert said.status == 0, said.err
    played = json.loads(said.out)
    # Without a policy, the robot falls within 0.5 s.
    assert played["figures"]["survival"] == 1.0
    # A robot that gets up is still rising after the first second, and rough ground and jumps move the base up and down.
    height_rmse, mean = played["figures"]["height_rmse_m"], played["figures"]["height_mean_m"]
    assert (height_rmse is None) == (name == "height")  # No fixed height: the height is commanded.
    assert (height_rmse or 0.0) < mean * {"get_up": 0.07, "terrain": 0.07, "jump": 0.16}.get(name, 0.028)
    verified = wheelleg("verify", f"stock:{name}")
    assert (verified.status, "sound: " in verified.out) == (0, True), verified.out
    # A wheelleg command accepts the printed folder name, too.
    assert RunDirectory.open(Path(played["run"]).name, Path("runs")).path == Path(played["run"])


def test_a_shipped_policy_is_unpacked_once_and_is_not_a_run_of_the_user(own_folders):
    words = ("env.num_envs=1", "env.episode_length_s=0.5", *QUICK)
    first, second = (json.loads(wheelleg("play", "stock:walk", *words).out) for _ in range(2))
    assert first["run"] == second["run"]
    assert len(list(Path(first["run"], "play").iterdir())) == 2
    assert "walk" not in wheelleg("list", "runs").out
    assert "no run" in refusal("play", "latest")


def test_a_shipped_policy_starts_a_training_and_is_not_resumed(own_folders):
    words = ["task=walk", "robot=physical", "realism=full", "init_from=stock:walk"]
    words += ["env.num_envs=4", "agent.max_iterations=1"]
    words += ["agent.algorithm.schedule=fixed", "agent.algorithm.learning_rate=1e-12", "recording.enabled=false"]
    said = wheelleg("train", *words)
    assert said.status == 0, said.err
    trained = torch.load(RunDirectory.open("latest", "runs").latest_checkpoint(), weights_only=True)
    stock = torch.load(RunDirectory.open("stock:walk", "runs").latest_checkpoint(), weights_only=True)
    weights = [state["actor_state_dict"]["mlp.0.weight"] for state in (trained, stock)]
    assert torch.allclose(*weights, atol=1e-6)
    resumed = wheelleg("resume", "stock:walk", "agent.max_iterations=900")
    assert (resumed.status, "a new training with init_from=stock:walk" in resumed.err) == (2, True), resumed.err
    with pytest.raises(RunDirectoryError, match="a training cannot be resumed from it"):
        require_resumable(stock)
    assert "ships without the log" in refusal("replay", "stock:walk")
    assert "ships without the log" in refusal("results", "page", "stock:walk", "protocol=stand")
    assert RunDirectory.open("stock:walk", "runs").manifest().status == "finished"


def test_a_changed_file_is_refused_and_not_unpacked(copied_policies):
    packed = copied_policies / "walk.zip"
    packed.write_bytes(packed.read_bytes()[:-1] + b"!")
    assert "walk.zip: the file is damaged" in refusal("play", "stock:walk")
    assert not Path("runs", "stock").exists()


@pytest.mark.parametrize("what", ["changed", "deleted"])
def test_a_damaged_run_directory_is_refused_and_unpacked_again_after_its_removal(own_folders, what):
    run = RunDirectory.open("stock:walk", Path("runs"))
    path = run.path / "params" / "agent.yaml"
    path.write_text(path.read_text() + "#") if what == "changed" else path.unlink()
    assert "delete 'runs/stock/walk_" in refusal("play", "stock:walk")
    shutil.rmtree(run.path)
    assert RunDirectory.open("stock:walk", Path("runs")).path == run.path


def test_verify_does_not_believe_a_run_that_calls_itself_shipped(own_folders):
    run = RunDirectory.open("stock:walk", Path("runs"))
    foreign = Path(shutil.copytree(run.path, "foreign"))
    assert wheelleg("verify", foreign).status == 0
    (foreign / "params" / "agent.yaml").write_text((foreign / "params" / "agent.yaml").read_text() + "\n")
    said = wheelleg("verify", foreign)
    assert (said.status, "there is no source/git.json" in said.out) == (1, True), said.out


def test_two_processes_unpack_a_policy_at_the_same_time(own_folders, monkeypatch):
    folder = stock_policies.temporary_folder

    @contextmanager
    def later(target):
        with folder(target) as made:
            if not target.exists():
                monkeypatch.setattr(stock_policies, "temporary_folder", folder)
                stock_policies.stock_run("walk", Path("runs"))  # The other process is faster.
            yield made

    monkeypatch.setattr(stock_policies, "temporary_folder", later)
    run = RunDirectory.open("stock:walk", Path("runs"))
    assert run.latest_checkpoint().is_file()
    assert [path.name for path in run.path.parent.iterdir()] == [run.id]


@pytest.mark.parametrize("name", NAMES)
def test_the_evaluations_are_of_the_shipped_networks_and_no_file_names_a_folder_of_the_training(own_folders, name):
    run = RunDirectory.open(f"stock:{name}", Path("runs"))
    evaluations = run.manifest().data["additions"]
    assert {made["results"]["checkpoint_sha256"] for made in evaluations} == {sha256(run.latest_checkpoint())}
    texts = [path for path in run.path.rglob("*") if path.suffix in (".json", ".yaml", ".txt") and path.is_file()]
    # Only the paths of USD prims and URDF elements start with a slash.
    of_robots = "wheelleg|wheel_biped|robot(?:/link|/joint|/material|(?!/))"
    for path in texts:
        found = re.findall(rf"(?<![]\w.>+-])/(?!(?:{of_robots})\b)[a-z][\w./-]*", path.read_text())
        assert not found, path


def test_an_unknown_name_names_the_shipped_policies(own_folders):
    message = refusal("play", "stock:wlak")
    assert all(f"stock:{name}" in message for name in NAMES)
    assert "did you mean 'stock:walk'?" in message


def test_the_digests_are_those_of_the_files_and_the_files_are_small():
    folder = assets_dir() / "policies"
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in sorted(folder.glob("*.zip"))]
    assert (folder / stock_policies.SUMS).read_text().splitlines() == lines
    assert sum(path.stat().st_size for path in folder.iterdir()) < 15e6


@functools.cache
def metrics_of(name, *overrides):
    run = RunDirectory.open(f"stock:{name}", "runs")
    few = ["protocol.get_up.num_poses=8"] if name == "get_up" else []
    _, protocol = evaluation_settings(run, [*overrides, *few])
    return set(metric_names(on_reference_engine(load_params(run)[0]), saved_mjcf(run), protocol))


def checked(**measured):
    """Return the violated bounds if each metric has the value of its bound, except the ``measured`` ones."""
    module = runpy.run_path(str(ROOT / "docs" / "make_policies.py"))
    gates = read_yaml(assets_dir() / "policies" / stock_policies.GATES)

    def evaluate(name, overrides):
        stands = overrides == ["protocol=stand"]
        gate = gates["standing" if stands else "own"]
        gate = gate.get(name, gate)
        bounds = {**gate.get("at_least", {}), **gate.get("at_most", {})}
        assert set(bounds) <= metrics_of("walk" if stands else name, *overrides)
        values = bounds | {key: value for key, value in measured.items() if key in bounds}
        return SimpleNamespace(metrics={key: SimpleNamespace(value=value) for key, value in values.items()})

    return module["check"](NAMES, evaluate)


def test_a_policy_that_drifts_does_not_pass_unless_play_warns(own_folders):
    assert checked() == []
    assert checked(**{"stand/drift_worst": 0.347}) == [
        f"stock:{name}, protocol=stand: stand/drift_worst is 0.347, but must be at most 0.1"
        for name in NAMES
        if name != "get_up"
    ]
    words = ("env.num_envs=1", "env.episode_length_s=0.5", *QUICK)
    assert "it trembles at zero command" in wheelleg("play", "stock:get_up", *FEW["get_up"], *words).err
    assert "warning: this policy" not in wheelleg("play", "stock:walk", *words).err
