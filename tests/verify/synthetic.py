"""Small run directories with all files of a training, made without training."""

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import torch
import yaml

from wheelleg_exp.files import write_json, write_text
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import Manifest, text_with_digest
from wheelleg_exp.run.run_config import write_params
from wheelleg_exp.run.run_directory import RunDirectory

ITERATIONS = 5
CHECKPOINTS = (0, 2, 4)
ENV = {
    "num_envs": 4,
    "sim": {"dt": 0.005, "nthread": 1},
    "rewards": {"alive": {"_target_": "x.alive", "weight": 1.0}, "fall": {"_target_": "x.fall", "weight": -2.0}},
}
AGENT = {"max_iterations": ITERATIONS, "torch_threads": 1, "algorithm": {"gamma": 0.99}}
CONFIG = {
    "seed": 3,
    "task": {"name": "stand"},
    "env": ENV,
    "agent": AGENT,
    "recording": {"enabled": True, "interval": 2},
    "run": {"root": "runs"},
}


def state(iteration: int) -> dict[str, Any]:
    draw = torch.Generator().manual_seed(iteration)
    network = {"weight": torch.randn(3, 2, generator=draw), "bias": torch.tensor([0.5, -0.0, float("nan")])}
    return {
        "format_version": checkpoint.FORMAT_VERSION,
        "iter": iteration,
        "infos": None,
        "actor_state_dict": network,
        "critic_state_dict": {"weight": torch.randn(2, generator=draw)},
        "optimizer_state_dict": {
            "state": {0: {"step": torch.tensor(float(iteration))}},
            "param_groups": [{"lr": 1e-3}],
        },
        "env": {
            "counter": 24 * (iteration + 1),
            "state": torch.randn(4, 5, generator=draw, dtype=torch.float64),
            "streams": {"events": torch.arange(8, dtype=torch.uint8)},
        },
        "log": {"returns": [1.0, 2.0]},
        "rng": {"torch": torch.arange(16, dtype=torch.uint8)},
    }


def line(iteration: int) -> dict[str, Any]:
    scalars = {
        "Train/mean_reward": 10.0 + iteration,
        "Train/mean_episode_length": 100.0 + iteration,
        "Loss/value": 0.25 / (1 + iteration),
        "Loss/zero": 0.0,
        "Perf/total_fps": 1234.5 + iteration,
    }
    found = digests.of_state(state(iteration))
    return {"iteration": iteration, "digest_format": digests.FORMAT, "digests": found, "scalars": scalars}


def build(root: Path) -> RunDirectory:
    run = RunDirectory.create(root, "stand", 3, "small")
    manifest = Manifest.begin(run.path, task="stand", seed=3, command=["wheelleg", "train"], threads={"torch": 1})
    write_params(run.path, {"env": ENV, "agent": AGENT})
    run.hydra.mkdir()
    (run.hydra / "config.yaml").write_text(yaml.safe_dump(CONFIG, sort_keys=False))
    run.environment.write_text("# python\nnumpy==2.0\nPyYAML==6.0  # editable\n")
    _write_source(run.source)
    _write_asset(run.asset)
    manifest.record(
        source={"status": "ok", "commit": "c" * 40, "tree": "a" * 40, "dirty": True}, files=inventory(run.path)
    )
    run.iterations.write_text("".join(json.dumps(line(i)) + "\n" for i in range(ITERATIONS)))
    for iteration in CHECKPOINTS:
        (run.path / f"model_{iteration}.pt").write_bytes(checkpoint.serialize(state(iteration)))
    write_recording(run.recording)
    write_policy(run.exported)
    (run.path / "events.out.tfevents.1").write_bytes(b"events")
    results = {"checkpoint": "model_4.pt", "iterations": ITERATIONS, "seconds": 1.5, "Train/mean_reward": 14.0}
    manifest.finish("finished", results)
    record(run)
    return run


def _write_source(folder: Path) -> None:
    patch = b"--- a\n+++ b\n"
    folder.mkdir()
    (folder / "source.patch").write_bytes(patch)
    kept = {"patch": "source.patch", "patch_sha256": hashlib.sha256(patch).hexdigest(), "note": None, "others": []}
    facts = {"format": 1, "status": "ok", "commit": "c" * 40, "tree": "a" * 40, "dirty": True, "root": "/home/me/pet"}
    facts |= {"base": "c" * 40, "contents": {"terms.py": [None, f"100644 {'1' * 40}"]}}
    write_json(folder / "git.json", {**facts, **kept})


def _write_asset(folder: Path) -> None:
    folder.mkdir()
    (folder / "robot.xml").write_text("<mujoco/>\n")
    write_json(folder / "asset.json", {"sources": {"robot.usda": "d" * 64}, "model_sha256": "e" * 64})


def write_policy(folder: Path, weights: bytes = b"weights", code: bytes = b"code", places: bytes = b"places") -> None:
    folder.mkdir(exist_ok=True)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        records = {"data/0": weights, "code/__torch__.py": code, "code/__torch__.py.debug_pkl": places}
        for name, data in records.items():
            file.writestr(zipfile.ZipInfo(f"policy/{name}"), data)
    (folder / "policy.pt").write_bytes(archive.getvalue())
    (folder / "policy.onnx").write_bytes(b"onnx")
    (folder / "policy.json").write_text('{"format_version": 1}\n')


def write_recording(path: Path, height: float = 0.07, fps: float = 100.0) -> None:
    stream = rr.RecordingStream("test", recording_id=str(path), send_properties=False)
    stream.save(path)
    columns = {"base/height": [height, 0.08, 0.09], "base/pitch": [0.1, 0.2, 0.3], "training/Perf/total_fps": [fps] * 3}
    for entity, values in columns.items():
        steps = rr.TimeColumn("step", sequence=np.arange(3))
        stream.send_columns(entity, [steps], rr.Scalars.columns(scalars=np.asarray(values)))
    stream.log("documents/command", rr.TextDocument(str(path)), static=True)
    stream.disconnect()


def record(run: RunDirectory) -> None:
    """Record the present files in the manifest, so that only the contents of files can reveal a change."""
    edit(run, lambda data: data.update(files=inventory(run.path)))


def edit(run: RunDirectory, change: Callable[[dict[str, Any]], Any]) -> None:
    data = run.manifest().data
    change(data)
    write_text(run.path / "manifest.json", text_with_digest(data))


def edit_state(run: RunDirectory, iteration: int, change: Callable[[dict[str, Any]], Any]) -> None:
    path = run.checkpoint(iteration)
    content = checkpoint.load(path, finite=False)
    change(content)
    path.write_bytes(checkpoint.serialize(content))


def edit_line(run: RunDirectory, iteration: int, change: Callable[[dict[str, Any]], Any]) -> None:
    values = [json.loads(text) for text in run.iterations.read_text().splitlines()]
    change(values[iteration])
    run.iterations.write_text("".join(json.dumps(value) + "\n" for value in values))


def edit_params(run: RunDirectory, change: Callable[[dict[str, Any], dict[str, Any]], Any]) -> None:
    env, agent = (yaml.safe_load((run.params / f"{part}.yaml").read_text()) for part in ("env", "agent"))
    change(env, agent)
    write_params(run.path, {"env": env, "agent": agent})


def edit_source(run: RunDirectory, **facts: Any) -> None:
    path = run.source / "git.json"
    record = {**json.loads(path.read_text()), **facts}
    path.write_text(json.dumps(record))
    edit(run, lambda data: data["source"].update({name: record[name] for name in facts if name in data["source"]}))


def shorten(run: RunDirectory, iterations: int) -> None:
    kept = run.iterations.read_text().splitlines()[:iterations]
    run.iterations.write_text("".join(text + "\n" for text in kept))
    for iteration in CHECKPOINTS:
        if iteration >= iterations:
            (run.path / f"model_{iteration}.pt").unlink()


def crash(run: RunDirectory) -> None:
    """Make a run look as after ``kill -9``: status ``running``, no process, and only the snapshot is recorded."""

    def change(data: dict[str, Any]) -> None:
        fixed = (".hydra/", "params/", "source/", "asset/", "environment.txt")
        files = {name: entry for name, entry in data["files"].items() if name.startswith(fixed)}
        data.update(status="running", ended=None, results={}, files=files)
        data["process"]["boot_id"] = "another boot"

    edit(run, change)
    shutil.rmtree(run.exported, ignore_errors=True)


def flip(path: Path, at: int | None = None) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)
