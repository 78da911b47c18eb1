import io
import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from foreign.trial import Trial, every_second
from wheelleg_exp.jobs.train.training_outputs import cut_events
from wheelleg_exp.rl import checkpoint

from .test_archives import Runs

pytestmark = pytest.mark.train

LAST = "model_2.pt"


def state(trial: Trial) -> dict[str, Any]:
    return checkpoint.load(trial.healthy.path / LAST)


def saved(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def repacked(data: bytes) -> bytes:
    """Return the archive with deflated records and one large record of zeros."""
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
        new.writestr("archive/data/999", bytes(1 << 26))
    return made.getvalue()


def doubled(depth: int) -> list[Any]:
    """Return a small object that takes endless time to traverse."""
    value: list[Any] = [0]
    for _ in range(depth):
        value = [value, value]
    return value


def nested(depth: int) -> list[Any]:
    return [nested(depth - 1)] if depth else []


PLANTS: dict[str, Callable[[Trial], bytes]] = {
    "a call": lambda trial: saved({**state(trial), "infos": Runs(trial.canary)}),
    "a plain pickle": lambda trial: pickle.dumps(Runs(trial.canary)),
    "a script": lambda trial: (trial.healthy.path / "exported" / "policy.pt").read_bytes(),
    "packed": lambda trial: repacked(saved(state(trial))),
    "a large tensor": lambda trial: saved({**state(trial), "infos": torch.zeros(1).expand(1 << 40)}),
    "no numbers": lambda trial: saved({**state(trial), "infos": torch.empty(1 << 40, device="meta")}),
    "sparse": lambda trial: saved({**state(trial), "infos": torch.zeros(3).to_sparse()}),
    "endless": lambda trial: saved({**state(trial), "infos": doubled(60)}),
    "deep": lambda trial: saved({**state(trial), "infos": nested(300)}),
    "no mapping": lambda trial: saved([1]),
    "other kinds": lambda trial: saved({**state(trial), "actor_state_dict": [1]}),
    "another name": lambda trial: saved({**state(trial), "iter": "../2"}),
    "a version": lambda trial: saved({**state(trial), "format_version": torch.ones(3)}),
    "nothing": lambda trial: b"",
}


@pytest.mark.parametrize(("name", "command"), every_second(PLANTS, ["verify", "compare"]))
def test_a_checkpoint_runs_nothing_and_is_as_large_as_its_file(trial, name, command):
    trial.write(LAST, PLANTS[name](trial))
    trial.try_("play", 2, LAST)
    trial.try_(command, 1, LAST)


@pytest.mark.parametrize("key", ["optimizer_state_dict", "env", "log", "rng", "unsaved"])
def test_a_checkpoint_with_parts_of_wrong_types_is_refused(trial, key):
    value = 7 if key in ("env", "rng") else {"torch": 1, "x": [torch.ones(2)]}
    for number in range(3):
        content = checkpoint.load(trial.run.path / f"model_{number}.pt")
        trial.write(f"model_{number}.pt", checkpoint.serialize({**content, key: value}))
    lines = [json.loads(text) for text in trial.run.iterations.read_text().splitlines()]
    trial.write("iterations.jsonl", "".join(json.dumps({**line, "digests": {}}) + "\n" for line in lines))
    trial.try_("resume", 2)
    trial.try_("verify", (0, 1))


def with_outside_weights(trial: Trial) -> bytes:
    model = onnx.load(trial.healthy.path / "exported" / "policy.onnx")
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    for key, value in (("location", "pipe"), ("length", "4")):
        tensor.external_data.add(key=key, value=value)
    os.mkfifo(trial.root / "here" / "pipe")
    return bytes(model.SerializeToString())


def with_large_weights(trial: Trial) -> bytes:
    model = onnx.load(trial.healthy.path / "exported" / "policy.onnx")
    model.graph.initializer[0].dims[:] = [1 << 40]
    return bytes(model.SerializeToString())


EXPORTED: dict[str, tuple[str, Callable[[Trial], bytes]]] = {
    "packed": ("policy.pt", lambda trial: repacked((trial.healthy.path / "exported" / "policy.pt").read_bytes())),
    "a call": ("policy.pt", lambda trial: saved(Runs(trial.canary))),
    "outside": ("policy.onnx", with_outside_weights),
    "large": ("policy.onnx", with_large_weights),
    "noise": ("policy.onnx", lambda _: b"\x0a\xff\xff\xff\xff\x7f"),
    "deep": ("policy.json", lambda _: b"[" * 100_000),
    "list": ("policy.json", lambda _: b"[]"),
}


@pytest.mark.parametrize(("name", "make"), EXPORTED.values(), ids=EXPORTED)
def test_an_exported_policy_is_not_run(trial, name, make):
    trial.write(f"exported/{name}", make(trial))
    trial.try_("verify", (0, 1))
    trial.try_("compare", 1, name)


def arrays(about: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, about=about)
    return buffer.getvalue()


FAILURES: dict[str, Callable[[Trial], bytes]] = {
    "a call": lambda trial: arrays(np.array([Runs(trial.canary)], dtype=object)),
    "packed": lambda _: repacked(arrays(np.array("{}"))),
    "deep": lambda _: arrays(np.array("[" * 100_000)),
    "list": lambda _: arrays(np.array("[]")),
    "nothing": lambda _: b"",
}


@pytest.mark.parametrize("make", FAILURES.values(), ids=FAILURES)
def test_a_damaged_failure_file_is_reported(trial, make):
    trial.write("failure.npz", make(trial))
    trial.manifest(failure={"file": "failure.npz", "key": "env.sim", "iteration": 1, "message": "x"})
    trial.try_("verify", 1, "failure.npz")


def test_events_of_any_length_are_cut(trial):
    kept = [json.loads(text) for text in trial.run.iterations.read_text().splitlines()]
    for content in (struct.pack("<QI", 1 << 63, 0) * 9, b"\xff" * 99, b"", np.arange(99).tobytes()):
        trial.write("events.out.tfevents.0", content)
        cut_events(trial.run.path, kept)
    assert list(trial.run.path.glob("events.out.tfevents.*"))
