"""Test the precision, the selection, and the repeatability of matrix products in bfloat16."""

import copy
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from patience import PATIENCE_S
from rsl_rl.modules import MLP
from torch import nn

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.torch_threads import dependent_products, set_threads
from wheelleg_exp.rl import matmul
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul, has_units, linear
from wheelleg_exp.rl.options import Agent

HALF_STEP = 2.0**-8  # This is the largest relative rounding error of bfloat16.
AGENT = Agent(
    **{"device": "cpu", "torch_threads": 1, "algorithm": {}, "matmul": "auto", "actor": {}, "critic": {}},
    **{"num_steps_per_env": 24, "max_iterations": 1, "save_interval": 1, "obs_groups": {}},
)


def drawn(rows=96, inputs=135, outputs=64):
    generator = torch.Generator().manual_seed(3)
    x, weight = torch.randn(rows, inputs, generator=generator), torch.randn(outputs, inputs, generator=generator)
    bias, grad = torch.randn(outputs, generator=generator), torch.randn(rows, outputs, generator=generator)
    return x, weight / inputs**0.5, bias, grad


def rounded(x):
    """Return numbers rounded to the 8 bits of bfloat16, to nearest with ties to even, as float64."""
    mantissa, exponent = torch.frexp(x.double())
    return torch.ldexp((mantissa * 256).round(), exponent - 8)


@pytest.fixture
def units(monkeypatch):
    """Simulate a CPU with or without bf16 vector instructions and AMX, from Intel or another vendor."""
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    monkeypatch.delenv("DNNL_MAX_CPU_ISA", raising=False)

    def set_to(there, amx=False, intel=False):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: there)
        monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
        monkeypatch.setattr(matmul, "is_intel", lambda: intel)

    return set_to


# --- precision ---


def test_a_product_of_rounded_factors_is_rounded_once():
    x, weight, bias, _ = drawn()
    exact = rounded(x) @ rounded(weight).t()
    added_up = rounded(x).abs() @ rounded(weight).abs().t()  # The error of float32 sums is proportional to this.
    found = linear(x, weight, bias)
    assert found.dtype == torch.float32
    error = (found.double() - (exact + bias.double())).abs()
    assert (error <= HALF_STEP * exact.abs() + 1e-6 * (added_up + bias.abs())).all()
    assert error.max() > 1e-4, "that was no bfloat16"


@pytest.mark.parametrize("elu", [False, True])
def test_gradients_are_those_of_float64_within_a_few_roundings(elu):
    x, weight, bias, grad = drawn()
    leaves = [t.clone().requires_grad_() for t in (x, weight, bias)]
    linear(*leaves, elu=elu).backward(grad.bfloat16() if elu else grad)
    exact = [t.double().requires_grad_() for t in (x, weight, bias)]
    y = exact[0] @ exact[1].t() + exact[2]
    torch.where(y > 0, y, torch.expm1(y) if elu else y).backward(grad.double())
    for leaf, other in zip(leaves, exact, strict=True):
        assert leaf.grad.dtype == torch.float32
        # The rounding errors of both factors, the result, and the derivative are independent, so their squares add up.
        assert (leaf.grad - other.grad).norm() <= 2 * HALF_STEP * other.grad.norm()


def test_elu_is_rounded_from_the_exact_one():
    x, weight, bias, _ = drawn()
    y = linear(x, weight, bias).double()
    exact = torch.where(y > 0, y, torch.expm1(y))
    found = linear(x, weight, bias, elu=True)
    assert found.dtype == torch.bfloat16
    assert ((found.double() - exact).abs() <= HALF_STEP * exact.abs() + 3e-7).all()


@pytest.mark.parametrize("activation", ["elu", "tanh", "sigmoid"])
def test_a_perceptron_has_float32_outputs_and_gradients_and_is_itself_again_afterwards(activation):
    torch.manual_seed(0)
    plain = MLP(135, 6, [64, 64], activation)
    x, low = torch.randn(50, 135), copy.deepcopy(plain)
    with bfloat16_products([low]):
        found = low(x)
    assert found.dtype == torch.float32
    exact = plain(x)
    assert not torch.equal(found, exact)
    assert (found - exact).norm() < 0.01 * exact.norm()
    for net, y in ((plain, exact), (low, found)):
        y.square().sum().backward()
        assert {p.grad.dtype for p in net.parameters()} == {torch.float32}
    for p, q in zip(low.parameters(), plain.parameters(), strict=True):
        assert (p.grad - q.grad).norm() < 0.02 * q.grad.norm()
    assert torch.equal(low(x), exact)


def test_small_layers_and_users_own_perceptrons_are_left_alone():
    class Own(MLP):
        def forward(self, x):
            return super().forward(2 * x)

    for net in (MLP(8, 2, [16], "elu"), Own(135, 2, [64], "elu"), nn.Sequential(nn.Linear(135, 64))):
        x = torch.randn(7, net[0].in_features)
        exact = net(x)
        with bfloat16_products([net]):
            assert torch.equal(net(x), exact)


# --- selection of bfloat16 ---


@pytest.mark.parametrize(
    ("cpu", "found"),
    [((False,), "float32"), ((True,), "bfloat16"), ((True, False, True), "float32"), ((True, True, True), "bfloat16")],
)
def test_auto_takes_bfloat16_where_the_cpu_has_units_and_on_intels_cpus_only_with_amx(units, cpu, found):
    units(*cpu)
    assert has_units() == (found == "bfloat16")
    assert chosen_matmul(AGENT) == set_threads(AGENT, 1)["matmul"] == found
    assert chosen_matmul(replace(AGENT, matmul=Agent.matmul)) == "float32"  # as in runs of before this key


@pytest.mark.parametrize(
    ("most", "vectors", "tiles"),
    [
        ("AVX2", False, False),
        ("AVX512_CORE_VNNI", False, False),
        ("AVX512_CORE_FP16", True, False),
        ("avx512_core_amx", True, True),
        ("ALL", True, True),
    ],
)
def test_units_that_onednn_may_not_use_do_not_count(units, monkeypatch, most, vectors, tiles):
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", most)
    units(True)
    assert has_units() == vectors
    units(True, amx=True, intel=True)
    assert has_units() == tiles
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert not has_units()


@pytest.mark.parametrize(
    ("other", "found", "refused"),
    [
        ({}, "bfloat16", "tf32"),
        ({"device": "cuda"}, "tf32", "bfloat16"),
        ({"torch_compile_mode": "default"}, "float32", "bfloat16"),
    ],
)
def test_gpus_take_tf32_and_compiled_networks_float32(units, other, found, refused):
    units(True)
    assert chosen_matmul(replace(AGENT, **other)) == found
    with pytest.raises(ConfigError, match=r"agent\.matmul"):
        chosen_matmul(replace(AGENT, **other, matmul=refused))


# --- in a training ---

WIDE = ["agent.actor.hidden_dims=[64,64]", "agent.critic.hidden_dims=[64,64]", "env.num_envs=4"]


def test_the_update_alone_is_in_bfloat16(make_trainer, monkeypatch):
    multiplied = []
    monkeypatch.setattr(matmul, "linear", lambda *args, **kwargs: multiplied.append(1) or linear(*args, **kwargs))
    trainer = make_trainer(*WIDE, "agent.matmul=bfloat16")
    update = trainer.algorithm.update
    trainer.algorithm.update = lambda: (multiplied.append(0), update(), multiplied.append(0))[1]
    list(trainer.learn(until=1))
    assert multiplied[0] == multiplied[-1] == 0
    assert 1 in multiplied


def test_weights_and_optimiser_stay_float32_and_learn_nearly_the_same(make_trainer):
    states = {}
    for kind in ("float32", "bfloat16"):
        trainer = make_trainer(*WIDE, f"agent.matmul={kind}")
        list(trainer.learn(until=1))
        states[kind] = trainer.state_dict()
    one, other = (states[kind]["actor_state_dict"] for kind in states)
    assert not torch.equal(one["mlp.0.weight"], other["mlp.0.weight"])
    assert (one["mlp.0.weight"] - other["mlp.0.weight"]).norm() < 0.05 * one["mlp.0.weight"].norm()
    moments = states["bfloat16"]["optimizer_state_dict"]["state"].values()
    assert {t.dtype for m in moments for t in m.values()} | {t.dtype for t in other.values()} == {torch.float32}


CODE = """
import hashlib, sys, torch
from rsl_rl.modules import MLP
from wheelleg_exp.rl.matmul import bfloat16_products
for threads in map(int, sys.argv[1:]):
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    for rows in (96, 1001, 3072):
        net, x = MLP(135, 6, [512, 256, 128], "elu"), torch.randn(rows, 135)
        with bfloat16_products([net]):
            y = net(x)
            y.square().mean(0).sum().backward()
        for t in (y, *(p.grad for p in net.parameters())):
            print(hashlib.sha256(t.detach().numpy().tobytes()).hexdigest())
"""


def bits(*threads, **variables):
    """Return digests of outputs and gradients for each number of threads, computed in a child process."""
    environ = os.environ | {"MKL_CBWR": "AVX2,STRICT", "OMP_WAIT_POLICY": "PASSIVE"} | variables
    command = [sys.executable, "-c", CODE, *map(str, threads)]
    said = subprocess.run(command, env=environ, capture_output=True, timeout=PATIENCE_S, check=True).stdout.split()
    assert len(said) == 27 * len(threads)
    return [said[first : first + 27] for first in range(0, len(said), 27)]


def test_thread_counts_give_the_same_bits_without_amx():
    one, two, three = bits(1, 2, 3, ONEDNN_MAX_CPU_ISA="AVX512_CORE_FP16")
    assert one == two == three


def test_products_that_depend_on_threads_are_found_and_recorded(monkeypatch):
    nets = [MLP(135, 6, [64], "elu")]
    before = torch.get_num_threads()
    record = {"matmul": "bfloat16", "torch": 1, "independent": True, "dependent_because": []}
    monkeypatch.setattr(matmul, "_multiply", lambda a, b: (a.double() @ b.double()).bfloat16())
    assert dependent_products(nets, AGENT, 960, record) == {}
    monkeypatch.setattr(matmul, "_multiply", lambda a, b: torch.mm(a, b) + 0.01 * (torch.get_num_threads() == 8))
    assert dependent_products(nets, AGENT, 960, {**record, "matmul": "float32"}) == {}
    found = dependent_products(nets, AGENT, 960, record)
    assert found["independent"] is False
    assert "agent.matmul=float32" in found["dependent_because"][0]
    assert torch.get_num_threads() == before
    assert dependent_products([MLP(8, 2, [16], "elu")], AGENT, 960, record) == {}  # This precision uses no bfloat16.
