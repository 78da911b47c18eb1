"""A small training that tests share: it runs once, through the command line."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from wheelleg_exp.cli.main import main
from wheelleg_exp.run.run_directory import RunDirectory

ITERATIONS = 3
NUM_ENVS = 16
# Episodes have 18 steps, so that episodes end in every rollout of 24 steps.
TINY = [
    f"env.num_envs={NUM_ENVS}",
    "env.episode_length_s=0.3",
    "env.sim.nthread=1",
    "agent.torch_threads=1",
    "agent.num_steps_per_env=24",
    "agent.actor.hidden_dims=[16,8]",
    "agent.critic.hidden_dims=[16,8]",
    "agent.algorithm.num_learning_epochs=2",
]
SMALL = [*TINY, f"agent.max_iterations={ITERATIONS}", "agent.save_interval=1"]
SMALL += ["recording.interval=2", "recording.steps=30"]


@dataclass(frozen=True)
class Words:
    """The exit status, standard output, and standard error of a command."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Trained:
    """A finished run and the output of its command."""

    run: RunDirectory
    said: Words


def wheelleg(*words: str | Path) -> Words:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main([str(word) for word in words])
    return Words(status, out.getvalue(), err.getvalue())


def succeed(*words: str | Path) -> Words:
    said = wheelleg(*words)
    assert said.status == 0, said.out + said.err
    return said


def refused(*words: str | Path) -> str:
    """Return the error output of a command that must refuse its input."""
    said = wheelleg(*words)
    assert said.status == 2, said.out + said.err
    return said.err


def cache_of(factory: pytest.TempPathFactory) -> Path:
    return factory.getbasetemp() / "wheelleg-cache"


@contextmanager
def shared_cache(factory: pytest.TempPathFactory, threads: int | None = None) -> Iterator[None]:
    """Set the cache folder and, if it is given, the number of threads; restore both at the end."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(factory)))
        yield
    torch.set_num_threads(before)


def only_run(root: Path) -> Path:
    (path,) = (root / "stand").iterdir()
    return path


def manifest(run: Path) -> dict[str, Any]:
    return json.loads((run / "manifest.json").read_text())


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "iterations.jsonl").read_text().splitlines()]


def without_times(line: dict[str, Any]) -> dict[str, Any]:
    """Return a line of the iteration log without the scalars that depend on the time."""
    return {**line, "scalars": {k: v for k, v in line["scalars"].items() if not k.startswith("Perf/")}}


_trained: dict[Path, Trained] = {}


def trained_once(factory: pytest.TempPathFactory) -> Trained:
    """Return the one small training; tests that change the run must copy it."""
    base = factory.getbasetemp()
    if base not in _trained:
        root = factory.mktemp("trained") / "runs"
        with shared_cache(factory):
            said = succeed("train", *SMALL, f"run.root={root}", "run.name=small")
        _trained[base] = Trained(RunDirectory.open(only_run(root), root), said)
    return _trained[base]


def copied(trained: Trained, root: Path) -> RunDirectory:
    path = root / "runs" / "stand" / trained.run.id
    shutil.copytree(trained.run.path, path)
    return RunDirectory.open(path, root / "runs")
