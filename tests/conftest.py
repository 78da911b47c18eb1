"""What tests of the simulation, the managers and the environment share."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from wheelleg_exp.machine import prepare_threads, share_cores

if TYPE_CHECKING:
    from wheelleg_exp.env import ManagerBasedRLEnv

# Before anything imports torch: processes that tests start inherit the variables and must compute the same numbers.
prepare_threads()
share_cores()  # with other workers' tests

# Behind nohup, or a shell's "&", signals are ignored, and all children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number, handler in {signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: lambda *_: None}.items():
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# What tests write need not outlive a power cut, and a small training waits for the disk eighty times.
os.fsync = lambda descriptor: os.fstat(descriptor) and None

EnvMaker = Callable[..., "ManagerBasedRLEnv"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let ``--corpus DIR`` name the USD robots that are not in the repository."""
    parser.addoption("--corpus", metavar="DIR", help="folder of USD robots, in place of WHEELLEG_USD_CORPUS")


@pytest.fixture(scope="module", autouse=True)
def _own_projects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let no module's tests leave a user's project or code behind: the next ones may run in any order, in any process.

    A training takes what was imported from outside the environment for a part of its source.
    """
    from wheelleg_exp import packages

    before, known = dict(packages._joined), set(sys.modules)
    yield
    packages._joined.clear()
    packages._joined.update(before)
    base = f"{tmp_path_factory.getbasetemp()}{os.sep}"
    for name in set(sys.modules) - known:
        spec = getattr(sys.modules[name], "__dict__", {}).get("__spec__")  # torch's answer to any name at all
        places = (getattr(spec, "origin", None), *(getattr(spec, "submodule_search_locations", None) or ()))
        if any(place and place.startswith(base) for place in places):
            del sys.modules[name]


@pytest.fixture
def make_env() -> EnvMaker:
    """Build an environment on a small robot: ``make_env("rover", seed=1, rewards={...})``."""
    from sim.small_envs import ASSETS, env_config

    from wheelleg_exp.env import ManagerBasedRLEnv

    def make(name: str = "rover", /, *, seed: int = 0, **changes: Any) -> ManagerBasedRLEnv:
        return ManagerBasedRLEnv(env_config(name, **changes), ASSETS / f"{name}.xml", seed)

    return make


@pytest.fixture(scope="session")
def graphics() -> str:
    """The backend that draws on this machine; without one the test is skipped."""
    from wheelleg_exp.errors import WheellegError
    from wheelleg_exp.rendering.render_job import Order
    from wheelleg_exp.rendering.render_scene import Scene
    from wheelleg_exp.rendering.renderer import drawing

    try:
        with drawing(Order(Scene({}, (), None, 0, 1.0), 32, 32, 0)) as process:
            return process.backend
    except WheellegError as error:
        pytest.skip(f"no graphics: {error}")


@pytest.fixture
def allow_test_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let configs name terms that stand beside the tests."""
    from wheelleg_exp.terms import term_binding

    packages = term_binding.allowed_packages()
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: (*packages, "managers", "mdp", "env", "sim"))
