"""Fixtures with small trainers of the stock task."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from jobs.small import TINY, cache_of

from wheelleg_exp.asset import convert_cached
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.paths import find_asset
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv

MakeTrainer = Callable[..., Trainer]


@pytest.fixture(scope="module", autouse=True)  # On some CPUs threads change bits.
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def mjcf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = find_asset("wheelleg/wheelleg.usda")
    return convert_cached(source, cache_dir=cache_of(tmp_path_factory) / "assets").output


@pytest.fixture(scope="session")
def tiny_config() -> Callable[..., dict[str, Any]]:
    @functools.cache
    def composed(*overrides: str) -> dict[str, Any]:
        return compose(["task=stand", *TINY, *overrides]).config

    return lambda *overrides: copy.deepcopy(composed(*overrides))


@pytest.fixture(scope="session")
def make_trainer(mjcf: Path, tiny_config: Callable[..., dict[str, Any]]) -> MakeTrainer:
    def make(*overrides: str, seed: int = 0, **more: Any) -> Trainer:
        config = tiny_config(*overrides)
        env = ManagerBasedRLEnv(config["env"], mjcf, seed)
        agent = read_agent(config["agent"])
        return Trainer(RslRlVecEnv(env, agent.clip_actions), agent, seed, **more)

    return make


def without_times(done: Any) -> dict[str, float]:
    """Return the scalars of an iteration except measured times."""
    return {key: value for key, value in done.scalars.items() if not key.startswith("Perf/")}


def saved(state: dict[str, Any], folder: Path) -> Path:
    """Write a checkpoint to a folder, and return its path."""
    path = folder / "model_0.pt"
    path.write_bytes(checkpoint.serialize(state))
    return path
