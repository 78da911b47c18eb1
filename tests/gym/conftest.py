"""Small environments through Gymnasium's own registry; each distinct config is composed once per process."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jobs.small import cache_of

from wheelleg_exp.config.checking.find_mistakes import compose_valid

_once = functools.cache(lambda words, folders: compose_valid(words, config_dirs=folders))


def _composed(words, *, config_dirs):
    once = _once(tuple(words), tuple(config_dirs))
    return replace(once, config=copy.deepcopy(once.config))


@pytest.fixture(autouse=True, scope="module")
def shared_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        patch.setattr("wheelleg_exp.gym.task_env.compose_valid", _composed)
        yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
