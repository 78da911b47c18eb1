from __future__ import annotations

import importlib.util

import pytest

from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.sim import options

WARP = "env.sim.engine=warp"


def said(*overrides: str) -> list[str]:
    return [str(error) for error in check(compose(["task=stand", *overrides]))]


@pytest.fixture(autouse=True)
def _installed(monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: importlib.util.find_spec("torch"))


@pytest.mark.parametrize("overrides", [(), (WARP,), (WARP, "env.sim.device=cuda:1"), (WARP, "env.sim.solver=cg")])
def test_what_fits_is_right(overrides):
    assert said(*overrides) == []


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["env.sim.device=cuda:0"], "env.sim.device: the engine 'mujoco' runs on the CPU, not on 'cuda:0'"),
        ([WARP, "env.sim.device=gpu"], "env.sim.device: 'gpu' is not a device of the engine 'warp'"),
        (
            [WARP, "env.sim.device=cuda:0", "env.sim.deterministic=true"],
            "env.sim.deterministic: the engine 'warp' is not bit-reproducible on a GPU, even with",
        ),
        ([WARP, "env.sim.solver=pgs"], "env.sim.solver: the engine 'warp' has no solver 'pgs'"),
    ],
)
def test_what_does_not_fit_is_told_by_its_key(overrides, message):
    (error,) = said(*overrides)
    assert error.startswith(message)


def test_a_missing_package_is_told_with_what_installs_it(monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    (error,) = said(WARP)
    assert error.startswith("env.sim.engine: the engine 'warp' needs the package warp, which is not installed")
    assert "pip install 'wheelleg_exp[gpu]'" in error
