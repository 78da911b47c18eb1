import importlib.util

import pytest

from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.sim import options

WARP, PHYSX = "env.sim.engine=warp", "env.sim.engine=physx"


def said(*overrides: str) -> list[str]:
    return [str(error) for error in check(compose(["task=stand", *overrides]))]


@pytest.fixture(autouse=True)
def _installed(monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: importlib.util.find_spec("torch"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        *((words, None) for words in ([], [PHYSX], [WARP], [WARP, "env.sim.device=cuda:1"])),
        ([WARP, "env.sim.solver=cg"], None),
        ([f"env.sim.engine={{_target_: {options.ENGINES['mujoco'].target}}}"], None),
        ([f"env.sim.engine={{_target_: {options.ENGINES['mujoco'].target}}}", "env.sim.device=cuda:0"],
         f"env.sim.device: the engine '{options.ENGINES['mujoco'].target}' runs on the CPU, not on 'cuda:0'"),
        (["env.sim.engine=wrap"], "env.sim.engine: 'wrap' is not known"),
        (["env.sim.device=cuda:0"], "env.sim.device: the engine 'mujoco' runs on the CPU, not on 'cuda:0'"),
        ([PHYSX, "env.sim.device=cuda:0"], "env.sim.device: the engine 'physx' runs on the CPU, not on 'cuda:0'"),
        ([PHYSX, "env.sim.deterministic=true"], "env.sim.deterministic: the engine 'physx' does not continue a"),
        ([WARP, "env.sim.device=gpu"], "env.sim.device: 'gpu' is not a device of the engine 'warp'"),
        ([WARP, "env.sim.device=cuda:0", "env.sim.deterministic=true"], None),
        ([WARP, "env.sim.solver=pgs"], "env.sim.solver: the engine 'warp' has no solver 'pgs'"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_the_engine_are_reported_by_their_key(overrides, message):
    errors = said(*overrides)
    assert len(errors) == (message is not None)
    assert all(error.startswith(message) for error in errors)


def test_a_missing_package_is_reported_with_its_install_command(monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    for engine, package, extra in (("warp", "warp", "gpu"), ("physx", "ovphysx", "physx")):
        (error,) = said(f"env.sim.engine={engine}")
        missing = f"env.sim.engine: the engine '{engine}' needs the package {package}, which is not installed"
        assert error.startswith(missing)
        assert f"pip install 'wheelleg_exp[{extra}]'" in error
