"""Spy managers for the tests of the environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from managers import spies

from wheelleg_exp.env import ManagerBasedRLEnv


@pytest.fixture(autouse=True)
def _spies(allow_test_terms: None) -> Iterator[None]:
    spies.clear()
    spies.clear()


@pytest.fixture
def start_env(make_env: Callable[..., ManagerBasedRLEnv]) -> Callable[..., ManagerBasedRLEnv]:
    """Build and reset an environment on a small robot, with the arguments of ``make_env``."""

    def start(name: str = "rover", /, **changes: Any) -> ManagerBasedRLEnv:
        env = make_env(name, **changes)
        env.reset()
        return env

    return start
