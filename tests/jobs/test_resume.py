"""A run that was stopped anywhere and resumed equals an uninterrupted run."""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import torch
import yaml
from patience import thinned
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from jobs.replays import change_manifest
from jobs.small import SMALL, lines, manifest, only_run, refused, succeed, wheelleg, without_times
from wheelleg_exp import packages as projects
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.train import resume_training as resume_changes
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.jobs.train import training_outputs
from wheelleg_exp.mdp import rewards
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.rl import checkpoint, digests, trainer
from wheelleg_exp.run import environment
from wheelleg_exp.run.manifest import SNAPSHOT, Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock
from wheelleg_exp.sim.batch_engine import BatchEngine

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("forks")]

FOUR = [*SMALL, "agent.max_iterations=4"]


@pytest.fixture(autouse=True)
def _same_source(monkeypatch):
    """Report no source differences, so that edits of the working tree have no effect on the tests."""
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])


SYNCED: list[str] = []


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> Path:
    """Train without a stop, and note which files go to the disk."""
    root, write = tmp_path_factory.mktemp("straight"), training_outputs.write_bytes
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_outputs, "sync", lambda path: SYNCED.append(path.name))
        patch.setattr(training_outputs, "write_bytes", lambda path, data: (SYNCED.append(path.name), write(path, data)))
        succeed("train", *FOUR, f"run.root={root}")
    return only_run(root)


@pytest.fixture
def run(straight, tmp_path) -> Path:
    path = tmp_path / "runs" / "stand" / straight.name
    shutil.copytree(straight, path)
    return path


def resume(run: Path, *words: str, status: int = 0):
    said = wheelleg("resume", run, *words)
    assert said.status == status, said.err
    return said


def require_equal(run: Path, straight: Path, extra: tuple[str, ...] = ()) -> None:
    """Compare all files of a run with those of the uninterrupted run."""
    for pattern in ("model_*.pt", "exported/*.onnx", "exported/*.json", "params/*"):
        expected = {str(p.relative_to(straight)): sha256(p) for p in straight.glob(pattern)}
        found = {str(p.relative_to(run)): sha256(p) for p in run.glob(pattern)}
        assert {name: found.get(name) for name in found if name not in extra} == expected
    assert [without_times(a) for a in lines(run)] == [without_times(b) for b in lines(straight)]
    assert (scalars(run), entity_digests(run / "recording.rrd")) == curves(straight)
    ends = [{k: v for k, v in manifest(path)["results"].items() if k != "seconds"} for path in (run, straight)]
    assert (ends[0], manifest(run)["status"]) == (ends[1], "finished")
    assert not RunDirectory.open(run, run.parents[1]).manifest().compare_files()
    assert not list(run.rglob("*.tmp"))


@functools.cache
def curves(straight: Path) -> tuple[dict[str, list[tuple[int, float]]], dict[str, str]]:
    """Return the scalars and the digests of the recording of a run whose files do not change."""
    return scalars(straight), entity_digests(straight / "recording.rrd")


def scalars(run: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith("Perf/")]
    return {tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in tags}


def events_left(run: Path) -> list[int]:
    """Return the steps of one scalar in the event files, including repeats."""
    files = sorted(run.glob("events.out.tfevents.*"))
    events = [event for path in files for event in EventFileLoader(str(path)).Load()]
    return [event.step for event in events for value in event.summary.value if value.tag == "Loss/value"]


def test_any_split_gives_what_one_go_gives(straight, tmp_path):
    succeed("train", *SMALL, "agent.max_iterations=1", f"run.root={tmp_path}")
    run = only_run(tmp_path)
    for total in (3, 4):
        resume(run, f"agent.max_iterations={total}")
    require_equal(run, straight)
    assert events_left(run) == [0, 1, 2, 3]
    entries = manifest(run)["resumes"]
    assert [entry["iteration"] for entry in entries] == [1, 3]
    assert all(entry["exact"] for entry in entries), entries


def interrupt_iteration_1(patch: pytest.MonkeyPatch) -> None:
    """Send SIGINT before the outputs of the second iteration are written."""
    write = training_outputs.Outputs.write

    def interrupted(self, iteration, due):
        if iteration.index == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return write(self, iteration, due)

    patch.setattr(training_outputs.Outputs, "write", interrupted)


def test_ctrl_c_and_a_long_save_interval_leave_one_more_checkpoint_and_the_same_others(straight, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_iteration_1(patch)
        said = wheelleg("train", *FOUR, "agent.save_interval=3", f"run.root={tmp_path}")
    run = only_run(tmp_path)
    assert said.status == 130
    assert f"resume {run.relative_to(Path.cwd()) if run.is_relative_to(Path.cwd()) else run}" in said.err
    assert sorted(path.name for path in run.glob("model_*.pt")) == ["model_0.pt", "model_1.pt"]
    resume(run, "--json")
    for name in ("model_0.pt", "model_1.pt", "model_3.pt"):
        assert sha256(run / name) == sha256(straight / name), name
    assert not (run / "model_2.pt").exists()
    assert events_left(run) == [0, 1, 2, 3]


@pytest.fixture(scope="module")
def killed():
    """Return a function that runs a command in a fork of one process; the fork kills itself at a point."""
    program = [sys.executable, str(Path(__file__).with_name("killed.py"))]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def kill(point: str, *words: str | Path) -> None:
            print(json.dumps([point, *map(str, words)]), file=process.stdin, flush=True)
            assert process.stdout.readline().strip() == str(-signal.SIGKILL), point

        yield kill


def test_kill_9_at_any_moment(straight, tmp_path, killed):
    killed("checkpoint:1", "train", *FOUR, f"run.root={tmp_path}")
    run = only_run(tmp_path)
    assert [path.name for path in run.glob("model_*.pt")] == ["model_0.pt"]
    killed("torn:2", "resume", run)
    assert not (run / "iterations.jsonl").read_bytes().endswith(b"\n")
    assert sorted(path.name for path in run.glob("model_*.pt")) == ["model_0.pt", "model_1.pt"]
    killed("manifest", "resume", run)
    assert manifest(run)["status"] == "running"
    assert (run / "model_3.pt").exists()
    resume(run)
    require_equal(run, straight)
    assert (events_left(run), [entry["iteration"] for entry in manifest(run)["resumes"]]) == ([0, 1, 2, 3], [1, 2, 4])


def test_an_engine_that_repeats_no_bits_leaves_all_digests_with_due_checkpoints_alone(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(BatchEngine, "exact", False)
        interrupt_iteration_1(patch)
        said = wheelleg("train", *FOUR, "agent.save_interval=3", f"run.root={tmp_path}")
    assert said.status == 130, said.err
    path = only_run(tmp_path)
    first, second = (line["digests"] for line in lines(path))
    assert len(first) > 3
    assert (list(second), wheelleg("verify", path).status) == (["parameters"], 0)
    state = torch.load(path / "model_1.pt", weights_only=True)
    assert second == digests.of_state(digests.networks(state))
    next(iter(state["actor_state_dict"].values())).view(-1)[0] += 1.0
    (path / "model_1.pt").write_bytes(checkpoint.serialize(state))
    told = wheelleg("verify", path)
    assert told.status == 1
    assert "does not agree with the log's digests of parameters" in told.out


def test_without_a_checkpoint_a_run_starts_from_scratch(run, straight):
    for path in run.glob("model_*.pt"):
        path.unlink()
    assert "resuming from the start" in resume(run).err
    require_equal(run, straight)
    assert manifest(run)["resumes"][0]["proved"] == [0, 3]


def test_a_damaged_checkpoint_and_a_half_written_line_are_passed_over(run, straight):
    data, flipped = (run / "model_3.pt").read_bytes(), bytearray((run / "model_2.pt").read_bytes())
    (run / "model_3.pt").write_bytes(data[: len(data) // 2])
    flipped[len(flipped) // 2] ^= 1
    (run / "model_2.pt").write_bytes(flipped)
    with (run / "iterations.jsonl").open("a") as file:
        file.write('{"iteration": 4, "dig')
    crash(run)
    said = resume(run)
    assert "model_3.pt cannot be used" in said.err
    assert "resuming from model_1.pt, iteration 2" in said.err
    for name in ("model_3.pt.damaged", "model_2.pt.damaged"):
        (run / name).unlink()
    assert manifest(run)["resumes"][0]["proved"] == [2, 3]
    for path in (run, straight):
        assert sorted(p.name for p in path.glob("model_*.pt")) == [f"model_{i}.pt" for i in range(4)]
    for index in range(4):
        assert sha256(run / f"model_{index}.pt") == sha256(straight / f"model_{index}.pt")
    assert scalars(run) == curves(straight)[0]


def test_lost_events_are_rewritten_from_the_log(run, straight):
    (run / "model_3.pt").unlink()
    for path in run.glob("events.out.tfevents.*"):
        path.write_bytes(path.read_bytes()[:300])
    resume(run)
    assert manifest(run)["threads"]["torch"] == torch.get_num_threads() == 1
    assert (events_left(run), scalars(run)) == ([0, 1, 2, 3], curves(straight)[0])


def test_the_logs_are_on_the_disk_before_the_checkpoint_is(straight):
    assert (straight / "model_3.pt").is_file()
    order = [name.split(".")[0] if name.startswith("events") else name for name in SYNCED]
    assert order[:4] == ["iterations.jsonl", "recording.rrd", "events", "model_0.pt"]
    assert order[-4:] == ["iterations.jsonl", "recording.rrd", "events", "model_3.pt"]


def test_a_run_that_was_killed_while_its_source_was_stored_is_completed(straight, tmp_path, killed):
    killed("source", "train", *FOUR, f"run.root={tmp_path}")
    run = only_run(tmp_path)
    assert not (run / "source" / "git.json").exists()
    assert manifest(run)["source"] == {}
    resume(run)
    require_equal(run, straight)
    assert manifest(run)["source"]["status"]


def crash(run: Path) -> None:
    """Let a run look as after ``kill -9``: it says running, its process is gone, and only the snapshot is recorded."""
    told = manifest(run)
    files = {name: record for name, record in told["files"].items() if name.startswith(SNAPSHOT)}
    change_manifest(run, status="running", ended=None, process={**told["process"], "boot_id": "another"}, files=files)


def test_damage_that_a_resume_does_not_mend_ends_exactness_and_is_not_forgotten(run):
    (run / "model_0.pt").unlink()
    log = (run / "iterations.jsonl").read_bytes()
    (run / "iterations.jsonl").write_bytes(log.replace(b'"iteration": 0, ', b'"iteration": 0,  ', 1))
    with (run / "environment.txt").open("a") as file:
        file.write("more==1\n")
    said = resume(run, "agent.max_iterations=5")
    entry = manifest(run)["resumes"][0]
    assert entry["exact"] is False
    assert [reason.split()[0] for reason in entry["why"]] == ["model_0.pt", "environment.txt", "iterations.jsonl"]
    assert "not exact" in said.err
    found = wheelleg("verify", run)
    assert found.status == 1
    assert "  model_0.pt is missing" in found.out.splitlines()


def test_overrides_act_from_there_on_are_recorded_and_end_exactness(run, straight):
    changed = {"env.rewards.alive.weight": 2.5, "agent.algorithm.learning_rate": 0.0005, "agent.max_iterations": 5}
    said = resume(run, *(f"{key}={value}" for key, value in changed.items()), "recording.enabled=false", "--json")
    assert json.loads(said.out)["resume"]["exact"] is False
    entry = manifest(run)["resumes"][0]
    assert {c["key"] for c in entry["changes"]} == {*changed, "recording.enabled"}
    assert len(entry["why"]) == 2
    assert "env.rewards.alive.weight was 5.0 and is 2.5" in entry["why"]
    assert "not exact" in said.err
    assert "weight: 2.5" in (run / "params" / "env.yaml").read_text()
    assert "agent.algorithm.learning_rate=0.0005" in (run / ".hydra" / "overrides.yaml").read_text()
    assert lines(run)[4]["scalars"]["Loss/learning_rate"] != lines(straight)[3]["scalars"]["Loss/learning_rate"]
    assert not RunDirectory.open(run, run.parents[1]).manifest().compare_files()
    resume(run, "agent.max_iterations=6", "agent.torch_threads=2")
    assert manifest(run)["resumes"][1]["exact"] is True
    assert "weight: 2.5" in (run / "params" / "env.yaml").read_text()


@pytest.mark.parametrize("kind", ["float32", "bfloat16"])
def test_a_resume_multiplies_as_the_run_did_whatever_the_cpu_has(run, monkeypatch, kind):
    change_manifest(run, threads={**manifest(run)["threads"], "matmul": kind})
    monkeypatch.setattr("wheelleg_exp.rl.matmul.has_units", lambda: kind == "float32")
    used = []
    monkeypatch.setattr(trainer, "chosen_matmul", lambda agent: used.append(agent.matmul) or agent.matmul)
    assert (resume(run, "agent.max_iterations=5").status, used, manifest(run)["threads"]["matmul"]) == (0, [kind], kind)


def test_a_crash_while_changed_settings_are_written_is_made_good(run, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Manifest, "write_pending", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            Manifest.load(run).restart(command=[], threads={}, texts={"params/agent.yaml": "max_iterations: 9\n"})
    assert "max_iterations: 4" in (run / "params" / "agent.yaml").read_text()
    Manifest.load(run).write_pending()
    assert (run / "params" / "agent.yaml").read_text() == "max_iterations: 9\n"
    assert not [f for f in RunDirectory.open(run, run.parents[1]).manifest().compare_files().changed]


def test_another_machine_ends_exactness(run, monkeypatch):
    present = environment.versions()
    assert manifest(run)["engine"]["version"] == present["mujoco-core"] == mujoco.mj_versionString()
    monkeypatch.setattr(environment, "versions", lambda: {**present, "mujoco-core": "4.0.9"})
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "default")
    (run / "model_3.pt").unlink()
    said = resume(run)
    entry = manifest(run)["resumes"][0]
    assert entry["exact"] is False
    differences = {("versions", "mujoco-core"), ("environment_variables", "ATEN_CPU_CAPABILITY")}
    assert {(d["section"], d["name"]) for d in entry["differences"]} == differences
    assert "4.0.9" in said.err


def test_state_that_no_checkpoint_holds_is_noticed(run, monkeypatch):
    calls, function = [], rewards.is_alive

    @functools.wraps(function)
    def is_alive(env):
        calls.append(1)
        return function(env) + len(calls) / 1000.0

    (run / "model_3.pt").unlink()
    monkeypatch.setattr(rewards, "is_alive", is_alive)
    said = resume(run)
    entry = manifest(run)["resumes"][0]
    assert entry["exact"] is False
    assert "iteration 3 differs from the iteration before the stop" in said.err
    assert "proved" not in entry


def refuse(run: Path, *words: str) -> str:
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file() and not p.name.endswith("lock")}
    said = refused("resume", run, *words)
    assert "Traceback" not in said
    (message,) = [line for line in said.splitlines() if line.startswith("wheelleg: error: ")]
    assert {p: p.read_bytes() for p in before} == before  # No file of the run has changed.
    return message


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "has done 4 iterations; expected more than 4: 'wheelleg resume"),
        (["agent.max_iterations=3"], "is 3, and the run has done 4 iterations"),
        (["agent.max_iteration=9"], "did you mean 'agent.max_iterations'?"),
        (["agent.max_iterations=9", "env.num_envs=8"], "with init_from=RUN, start from this run's networks"),
        (["agent.max_iterations=9", "seed=1"], "seed: cannot change in a resume"),
        (["agent.max_iterations=9", "env.robot.base=fixed"], "env.robot.base: cannot change"),
        (["agent.max_iterations=9", "env.sim.dt=0.001"], "env.sim.dt: cannot change"),
        (["agent.max_iterations=9", "agent.actor.hidden_dims=[4]"], "agent.actor.hidden_dims: cannot change"),
        (["agent.max_iterations=9", "~env.rewards.alive"], "the saved state has a place for each term"),
        (["agent.max_iterations=9", "env.observations.policy.history_length=2"], "with this observation"),
        (["agent.max_iterations=9,10"], "the command accepts only one value per key"),
        (["hydra.run.dir=x", "agent.max_iterations=9"], "hydra.run.dir: nothing reads this"),
    ],
)
def test_wrong_overrides_are_reported_before_anything_changes(run, words, said):
    assert said in refuse(run, *words)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("params/agent.yaml", b"max_iterations: 9\n", "was changed after the run started"),
        (".hydra/config.yaml", None, "is missing"),
        ("asset/robot.xml", b"<mujoco/>", "was changed after the run started"),
        ("iterations.jsonl", b"", "has no complete line of iteration 0"),
        ("manifest.json", b"{", "broken JSON"),
    ],
)
def test_a_damaged_run_is_reported_before_anything_changes(run, name, content, said):
    (run / name).unlink() if content is None else (run / name).write_bytes(content)
    assert said in refuse(run, "agent.max_iterations=9")


def test_a_checkpoint_of_another_run_is_no_checkpoint_of_this_one(run):
    for index in range(4):
        state = checkpoint.load(run / f"model_{index}.pt")
        state["actor_state_dict"]["mlp.0.bias"] += 1.0
        (run / f"model_{index}.pt").write_bytes(checkpoint.serialize(state))
    assert "parameters differ from the logged digests of iteration 3" in refuse(run, "agent.max_iterations=9")


def test_a_run_that_is_being_written_is_left_alone(run):
    with RunLock(run):
        message = refuse(run, "agent.max_iterations=9")
    assert f"is being written by process {os.getpid()}" in message
    refuse(run)
    with RunLock(run):
        pass  # The lock is free after a refusal.


def test_what_there_is_room_for_and_what_is_a_graph_may_change(run):
    words = ["env.sim.nconmax=64", "env.sim.njmax=99", "env.sim.graph=false", "env.sim.graph_step=true"]
    tree, changes = resume_changes.change_settings(resume_changes.recorded_tree(RunDirectory(run)), words)
    found = {"nconmax": 64, "njmax": 99, "graph": False, "graph_step": True}
    assert {change.key: change.b for change in changes} == {f"env.sim.{key}": value for key, value in found.items()}
    assert tree["env"]["sim"]["nconmax"] == 64


def test_a_variable_that_was_not_stored_is_requested_by_name(run, monkeypatch):
    path = run / ".hydra" / "config.yaml"
    config = yaml.safe_load(path.read_text())
    config["run"]["note"] = "${oc.env:MY_TOKEN}"
    path.write_text(yaml.safe_dump(config))
    change_manifest(run)
    message = refuse(run, "agent.max_iterations=5")
    assert "variable MY_TOKEN, which was not stored with the run" in message
    assert "expected MY_TOKEN set to its value at the start of the run" in message
    assert "KeyError" not in message


DECLARED = '[project]\nname = "pet"\nversion = "0"\n[project.entry-points."wheelleg_exp.packages"]\npet = "pet"\n'
PROJECT = {
    "pyproject.toml": DECLARED,
    "pet/__init__.py": "",
    "pet/terms.py": (
        "import torch\nfrom wheelleg_exp.managers import TermBase\n\n\n"
        "class Patience(TermBase):\n"
        '    def __init__(self, env):\n        self._seen = self.number("_seen", [])\n\n'
        "    def __call__(self, env):\n        self._seen.append(float(env.scene.robot.data.root_pos_w[0, 2]))\n"
        "        return torch.full((env.num_envs,), sum(self._seen) / len(self._seen))\n"
    ),
    "configs/reward/patience.yaml": "patience:\n  _target_: pet.terms.Patience\n  weight: 1.0\n",
}


@pytest.fixture
def project(tmp_path) -> Path:
    root = tmp_path / "pet"
    for name, text in PROJECT.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    yield root
    projects.forget(root)


@pytest.mark.parametrize("kind", thinned(["ignored", "linked"], 2))
def test_changed_code_that_git_does_not_store_ends_exactness(project, tmp_path, kind):
    terms = project / "pet" / "terms.py"
    subprocess.run(["git", "init", "-q", project], check=True)
    if kind == "ignored":
        (project / ".gitignore").write_text("terms.py\n")
    else:
        terms.rename(tmp_path / "terms.py")
        terms.symlink_to(tmp_path / "terms.py")
    words = [*SMALL, "+reward@env.rewards=patience", "agent.logger=null", "recording.enabled=false"]
    succeed("train", *words, "agent.max_iterations=1", f"run.root={tmp_path / 'runs'}", "--config-dir", project)
    run = only_run(tmp_path / "runs")
    assert manifest(run)["modules"]["pet.terms"] == sha256(terms)
    resume(run, "agent.max_iterations=2")
    with terms.open("a") as file:
        file.write("# changed\n")
    said = resume(run, "agent.max_iterations=3")
    assert [entry["exact"] for entry in manifest(run)["resumes"]] == [True, False]
    assert "modules pet.terms was" in said.err


def test_a_project_named_by_config_dir_is_found_again_and_its_term_resumes(project, tmp_path):
    words = [*SMALL, "+reward@env.rewards=patience", "agent.logger=null", "recording.enabled=false"]
    runs = []
    for total in (2, 1):
        root = tmp_path / f"runs_{total}"
        succeed("train", *words, f"agent.max_iterations={total}", f"run.root={root}", "--config-dir", project)
        runs.append(only_run(root))
    projects.forget(project)
    resume(runs[1], "agent.max_iterations=2")
    assert sha256(runs[1] / "model_1.pt") == sha256(runs[0] / "model_1.pt")
    moved = project.with_name("moved")
    project.rename(moved)
    projects.forget(project)
    said = resume(runs[1], "agent.max_iterations=3", status=2)
    assert "pet.terms.Patience" in said.err
    assert f"what the run was made with is gone: {project / 'configs'}" in said.err
    assert "--config-dir" in said.err
    assert "Traceback" not in said.err
    try:
        resume(runs[1], "agent.max_iterations=3", "--config-dir", str(moved))
    finally:
        projects.forget(moved)
    assert not list(runs[1].glob("events.out.tfevents.*"))


def test_a_failed_run_resumes(straight, tmp_path, monkeypatch):
    write = training_outputs.write_bytes

    def full(path, data):
        if path.name == "model_2.pt":
            raise SimulationFailure("cannot write: no space left on device")
        write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(training_outputs, "write_bytes", full)
        said = wheelleg("train", *FOUR, f"run.root={tmp_path}")
    run = only_run(tmp_path)
    assert said.status == 3
    assert "resume with: " in said.err
    assert manifest(run)["status"] == "failed"
    resume(run)
    require_equal(run, straight)
    assert manifest(run)["resumes"][0]["proved"] == [2, 2]


def test_results_describe_the_last_iteration_and_not_the_one_before_the_resume(run, straight):
    change_manifest(run, results={**manifest(run)["results"], "stuck_curricula": ["old"], "non_finite": {"a": 1}})
    log = [json.loads(line) for line in (run / "iterations.jsonl").read_text().splitlines()]
    log[-1]["scalars"]["Episode_Termination/rare"] = 1.0
    (run / "iterations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    resume(run, "agent.max_iterations=5")
    found, last = manifest(run)["results"], lines(run)[-1]["scalars"]
    assert (found["iterations"], found["checkpoint"]) == (5, "model_4.pt")
    assert {name for name in found if "/" in name} == {name for name in last if name in found}
    assert not {"stuck_curricula", "non_finite", "Episode_Termination/rare"} & found.keys()
