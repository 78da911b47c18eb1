"""A training's run directory: complete, readable, and enough to build the same environment and policy again."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from forks import forking
from patience import PATIENCE_S
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jobs.small import ITERATIONS, NUM_ENVS, SMALL, lines, manifest, only_run, wheelleg
from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.definitions import scalar_definition
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import Interrupted
from wheelleg_exp.jobs.train import prepare_training, run_training, training_outputs
from wheelleg_exp.mdp import observations
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl import export as export_module
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train

TERMINATIONS = ("time_out", "base_contact", "leg_contact", "non_finite_state")
ISAAC_LAB_KEYS = {
    *(f"Episode_Termination/{term}" for term in TERMINATIONS),
    *("Metrics/base_velocity/error_vel_xy", "Metrics/base_velocity/error_vel_yaw", "Curriculum/lin_vel_z_weight"),
    *("Loss/value", "Loss/surrogate", "Loss/entropy", "Loss/learning_rate", "Policy/mean_std"),
    *("Perf/total_fps", "Perf/collection_time", "Perf/learning_time"),
    *("Train/mean_reward", "Train/mean_episode_length"),
}
FILES = "manifest.json .hydra/config.yaml .hydra/hydra.yaml .hydra/overrides.yaml params/env.yaml params/agent.yaml "
FILES += "source/git.json environment.txt iterations.jsonl asset/asset.json asset/robot.xml asset/report.json "
FILES += "recording.rrd exported/policy.pt exported/policy.onnx exported/policy.json"


def checkpoints(path: Path) -> list[str]:
    return sorted(file.name for file in path.glob("model_*.pt"))


def test_every_file_exists_in_a_folder_named_after_task_time_seed_and_name(trained):
    path = trained.run.path
    assert [name for name in FILES.split() if not (path / name).is_file() or not (path / name).stat().st_size] == []
    assert checkpoints(path) == [f"model_{k}.pt" for k in range(ITERATIONS)]
    assert (len(list(path.glob("events.out.tfevents.*"))), list(path.rglob("*.tmp"))) == (1, [])
    assert path.parent.name == "stand"
    time.strptime(path.name.removesuffix("_0_small"), "%Y-%m-%d_%H-%M-%S")


def test_the_manifest_describes_the_end_and_has_the_sha256_of_every_other_file(trained):
    path, data = trained.run.path, manifest(trained.run.path)
    assert (data["status"], data["error"], data["task"], data["seeds"]) == ("finished", None, "stand", [0])
    assert (data["results"]["iterations"], data["results"]["checkpoint"]) == (ITERATIONS, f"model_{ITERATIONS - 1}.pt")
    assert data["threads"]["torch"] == data["threads"]["physics"] == 1
    assert data["ended"] >= data["started"]
    present = {str(f.relative_to(path)) for f in path.rglob("*") if f.is_file()}
    assert present - set(data["files"]) <= {"manifest.json", ".lock", ".manifest.lock"}
    for name, record in data["files"].items():
        content = (path / name).read_bytes()
        assert record == {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}, name


def test_hydras_files_compose_the_same_config_again(trained):
    overrides, config = (yaml.safe_load((trained.run.hydra / f"{x}.yaml").read_text()) for x in ("overrides", "config"))
    composed = compose(overrides).config
    assert composed["env"] == yaml.safe_load((trained.run.params / "env.yaml").read_text())
    assert (composed["seed"], f"env.num_envs={NUM_ENVS}" in overrides) == (config["seed"], True)


def test_the_robot_is_stored_with_the_hash_of_its_sources(trained):
    identity = json.loads((trained.run.asset / "asset.json").read_text())
    assert (identity["source"], "wheelleg.usda" in identity["sources"]) == ("wheelleg/wheelleg.usda", True)
    for name, digest in identity["sources"].items():
        assert hashlib.sha256((assets_dir() / "wheelleg" / name).read_bytes()).hexdigest() == digest


@pytest.fixture(scope="module")
def params(trained):
    folder = trained.run.params
    return tuple(yaml.safe_load((folder / f"{part}.yaml").read_text()) for part in ("env", "agent"))


@pytest.fixture(scope="module")
def rebuilt(trained, params):
    return ManagerBasedRLEnv(params[0], trained.run.asset / "robot.xml", 0)


def test_the_parameters_build_the_same_environment(trained, rebuilt):
    original = build_env(compose(["task=stand", *SMALL]).config)
    kept = json.loads((trained.run.asset / "asset.json").read_text())["model_sha256"]
    assert rebuilt.scene.model_digest() == original.scene.model_digest() == kept
    first, second = rebuilt.reset(seed=0)[0], original.reset(seed=0)[0]
    assert all(torch.equal(first[group], second[group]) for group in ("policy", "critic"))


def test_the_parameters_and_a_checkpoint_build_the_exported_policy(trained, params, rebuilt):
    adapter = RslRlVecEnv(rebuilt)
    policy = load_policy(trained.run.latest_checkpoint(), adapter, read_agent(params[1]))
    seen = adapter.get_observations()
    with torch.no_grad():
        expected = policy(seen).numpy()
    session = onnxruntime.InferenceSession(trained.run.exported / "policy.onnx")
    (found,) = session.run(None, {session.get_inputs()[0].name: seen["policy"].numpy()})
    np.testing.assert_allclose(found, expected, atol=1e-5)
    scripted = torch.jit.load(trained.run.exported / "policy.pt")(seen["policy"])
    np.testing.assert_allclose(scripted.detach().numpy(), expected, atol=1e-5)
    assert json.loads((trained.run.exported / "policy.json").read_text())["iteration"] == ITERATIONS - 1


def test_each_iteration_has_a_line_with_defined_scalars_and_the_digests_of_its_checkpoint(trained):
    found = lines(trained.run.path)
    assert [line["iteration"] for line in found] == list(range(ITERATIONS))
    names = ("parameters", "optimizer", "environment", "streams", "log")
    assert [set(line["digests"]) for line in found] == [{*names, "rest"}] * ITERATIONS
    assert [part for part in names if len({line["digests"][part] for line in found}) != ITERATIONS] == []
    for line in found:
        state = checkpoint.load(trained.run.checkpoint(line["iteration"]))
        assert state["iter"] == line["iteration"]
        assert (line["digest_format"], line["digests"]) == (digests.FORMAT, digests.of_state(state))
        assert [key for key in line["scalars"] if scalar_definition(key) is None] == []


def test_tensorboard_reads_isaac_labs_keys(trained):
    events = EventAccumulator(str(trained.run.path))
    events.Reload()
    rewards = yaml.safe_load((trained.run.params / "env.yaml").read_text())["rewards"]
    keys = ISAAC_LAB_KEYS | {f"Episode_Reward/{term}" for term in rewards}
    assert len(rewards) > 10
    assert set(events.Tags()["scalars"]) >= keys
    for key in keys:
        assert [point.step for point in events.Scalars(key)] == list(range(ITERATIONS)), key
    written = [line["scalars"]["Train/mean_reward"] for line in lines(trained.run.path)]
    assert [p.value for p in events.Scalars("Train/mean_reward")] == pytest.approx(written, rel=1e-6)


def test_the_manifest_counts_each_environment_s_last_episode_once(trained):
    state = checkpoint.load(trained.run.checkpoint(ITERATIONS - 1))["env"]["managers"]["terminations"]["_last_episode"]
    counts = trained.run.manifest().data["last_ended_by"]
    assert sum(counts.values()) == state.shape[1]
    assert sum(n for name, n in counts.items() if "time_out" in name) == int(state[0].sum())


def test_the_recording_contains_the_requested_samples_and_the_training_curves(trained):
    recording = Recording(trained.run.recording)
    table = recording.table("base/height")
    assert table.column("step").to_pylist() == [*range(1, 37), *range(55, 73)]
    assert table.column("iteration").to_pylist() == [0] * 24 + [1] * 12 + [2] * 18
    written = [line["scalars"]["Loss/value"] for line in lines(trained.run.path)]
    assert recording.values("training/Loss/value").ravel().tolist() == pytest.approx(written)
    assert "num_envs: 16" in (recording.document("config") or "")


def status_of(path: Path) -> str:
    return manifest(path)["status"]


def test_a_run_whose_observations_become_nan_fails(tmp_path, monkeypatch):
    function = observations.base_ang_vel

    @functools.wraps(function)
    def spoiled(env):
        value = function(env).clone()
        if env.common_step_counter > 30:  # in the second iteration
            value[3] = float("nan")
        return value

    monkeypatch.setattr(observations, "base_ang_vel", spoiled)
    said = wheelleg("train", *SMALL, f"run.root={tmp_path}")
    (message,) = [line for line in said.err.splitlines() if line.startswith("wheelleg: error: ")]
    assert "policy" in message
    assert "Traceback" not in said.err
    path = only_run(tmp_path)
    assert (said.status, status_of(path), len(lines(path))) == (3, "failed", 1)
    assert (manifest(path)["error"]["type"], checkpoints(path)) == ("SimulationFailure", ["model_0.pt"])
    Recording(path / "recording.rrd")


def _close_the_folder(path):
    for file in path.glob("model_*.pt"):
        file.unlink()
    (path / "exported").write_text("no folder")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (shutil.rmtree, "was removed while it was written"),
        (lambda path: (path / "manifest.json").write_text("[" * 100_000), "the JSON text is nested too deeply"),
        (_close_the_folder, "cannot write"),
    ],
)
def test_a_run_directory_that_is_damaged_during_the_training_fails_the_run(tmp_path, monkeypatch, damage, message):
    write = training_outputs.Outputs.checkpoint

    def spoiled(self, iteration):
        name = write(self, iteration)
        damage(self._directory.path)
        return name

    monkeypatch.setattr(training_outputs.Outputs, "checkpoint", spoiled)
    told = wheelleg("train", *SMALL, "agent.max_iterations=2", "recording.enabled=false", f"run.root={tmp_path}")
    assert told.status == 3, told.err
    (error,) = [line for line in told.err.splitlines() if line.startswith("wheelleg: error: ")]
    assert message in error
    assert not list(tmp_path.glob("stand/*/model_1.pt")) or damage is not shutil.rmtree


@pytest.mark.parametrize(
    ("owner", "name", "left"),
    [(Trainer, "_collect", []), (run_training, "export_policy", ["model_0.pt"])],
    ids=["before the first iteration", "during the export"],
)
def test_an_interrupt_is_no_failure(tmp_path, monkeypatch, owner, name, left):
    def interrupted(*_):
        raise Interrupted

    monkeypatch.setattr(owner, name, interrupted)
    assert wheelleg("train", *SMALL, "agent.max_iterations=1", f"run.root={tmp_path}").status == 130
    path = only_run(tmp_path)
    assert (status_of(path), checkpoints(path)) == ("interrupted", left)


def test_a_policy_that_cannot_be_exported_is_reported_in_one_line_with_its_key(tmp_path, monkeypatch):
    def refuses(_policy):
        raise TypeError("missing a required argument: 'h_in'\n\nand a report of many lines")

    monkeypatch.setattr(export_module, "onnx", refuses)
    said = wheelleg("train", *SMALL, "agent.max_iterations=1", f"run.root={tmp_path}")
    assert said.status == 3
    (error,) = [line for line in said.err.splitlines() if line.startswith("wheelleg: error: ")]
    assert "agent.actor.class_name: the trained policy cannot be exported: TypeError: missing a required" in error
    assert "report" not in said.err
    assert checkpoints(only_run(tmp_path)) == ["model_0.pt"]


def test_handlers_of_signals_come_back(trained):
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# A process that starts a session and opens a terminal gets the terminal's hang-up.
_TRAIN = """
import fcntl, os, sys, termios
from wheelleg_exp.cli.main import main

if os.isatty(0):
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.exit(main())
"""


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Return exit status and run of three long trainings, each stopped by a signal."""
    roots = {number: tmp_path_factory.mktemp(number.name) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    master, slave = os.openpty()
    os.set_blocking(master, False)
    command = [sys.executable, "-c", _TRAIN, "train", *SMALL, "agent.max_iterations=100000", "agent.save_interval=1000"]
    processes = []
    with forking():
        for number, root in roots.items():
            file = slave if number is signal.SIGHUP else os.open(root / "said", os.O_CREAT | os.O_RDWR)
            words = [*command, f"run.root={root}"]
            processes.append(
                subprocess.Popen(words, stdin=file, stdout=file, stderr=file, cwd=root, start_new_session=file == slave)
            )
            os.close(file)
    try:
        _signal_each_after(roots, master, iterations=3)
        statuses = [process.wait(PATIENCE_S) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return {number: (status, only_run(roots[number])) for number, status in zip(roots, statuses, strict=True)}


def _signal_each_after(roots: dict, terminal: int, iterations: int) -> None:
    """Send each training its signal as soon as it has done some iterations: a hang-up by closing its terminal."""
    waiting, deadline = dict(roots), time.monotonic() + PATIENCE_S
    while waiting:
        with suppress(BlockingIOError):
            while signal.SIGHUP in waiting and os.read(terminal, 1 << 16):
                pass
        assert time.monotonic() < deadline, "the training does not begin"
        for number, root in list(waiting.items()):
            found = list(root.glob("stand/*/iterations.jsonl"))
            if found and len(found[0].read_text().splitlines()) >= iterations:
                process = manifest(found[0].parent)["process"]["pid"]
                os.kill(process, number) if number is not signal.SIGHUP else os.close(terminal)
                del waiting[number]
        time.sleep(0.05)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_or_a_closed_terminal_stops_the_training_after_its_iteration(stopped, number):
    status, path = stopped[number]
    assert (status, status_of(path)) == (130, "interrupted")
    run = RunDirectory.open(path, path.parent.parent)
    done = [line["iteration"] for line in lines(path)]
    assert (done, checkpoint.load(run.latest_checkpoint())["iter"]) == (list(range(len(done))), done[-1])
    findings = run.manifest().compare_files()
    assert not findings, findings
    Recording(path / "recording.rrd")
    newest = max(path.glob("model_*.pt"), key=lambda p: p.stat().st_mtime)
    assert manifest(path)["results"]["checkpoint"] == newest.name
    if number is signal.SIGHUP:  # The process had no terminal left for messages.
        return
    err = (path.parents[1] / "said").read_text()
    assert [word for word in ("interrupted", run.latest_checkpoint().name) if word not in err] == []
    assert f"resume {path.relative_to(path.parents[1].parent)}" in err or "resume stand" in err
    assert "Traceback" not in err


def test_a_missing_package_is_one_message_before_there_is_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(prepare_training, "find_spec", lambda _: None)
    said = wheelleg("train", *SMALL, "agent.logger=wandb", f"run.root={tmp_path / 'runs'}")
    assert (said.status, said.err.count("agent.logger: the package wandb is not installed")) == (2, 1)
    assert "pip install wheelleg_exp[wandb]" in " ".join(said.err.split())
    assert "Traceback" not in said.err
    assert not (tmp_path / "runs").exists()
