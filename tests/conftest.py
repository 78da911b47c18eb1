"""What tests of the simulation, the managers and the environment share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from wheelleg_exp.threads import prepare_threads

if TYPE_CHECKING:
    from wheelleg_exp.env import ManagerBasedRLEnv

# Before anything imports torch: processes that tests start inherit the variables and must compute the same numbers.
prepare_threads()

EnvMaker = Callable[..., "ManagerBasedRLEnv"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let ``--corpus DIR`` name the USD robots that are not in the repository."""
    parser.addoption("--corpus", metavar="DIR", help="folder of USD robots, in place of WHEELLEG_USD_CORPUS")


@pytest.fixture
def make_env() -> EnvMaker:
    """Build an environment on a small robot: ``make_env("rover", seed=1, rewards={...})``."""
    from sim.small_envs import ASSETS, env_config

    from wheelleg_exp.env import ManagerBasedRLEnv

    def make(name: str = "rover", /, *, seed: int = 0, **changes: Any) -> ManagerBasedRLEnv:
        return ManagerBasedRLEnv(env_config(name, **changes), ASSETS / f"{name}.xml", seed)

    return make


@pytest.fixture
def allow_test_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let configs name terms that stand beside the tests."""
    from wheelleg_exp import terms

    packages = terms.allowed_packages()
    monkeypatch.setattr(terms, "allowed_packages", lambda: (*packages, "managers", "mdp", "env", "sim"))
