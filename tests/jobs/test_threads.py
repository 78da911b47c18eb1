"""Test the thread settings, the recorded settings, and the warnings for users."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import mujoco
import pytest
import torch
from patience import PATIENCE_S

from wheelleg_exp import machine as cores
from wheelleg_exp.jobs import torch_threads
from wheelleg_exp.jobs.torch_threads import set_threads, thread_notes
from wheelleg_exp.rl.determinism import SPLIT_ABOVE, one_thread
from wheelleg_exp.rl.options import Agent
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.sim.batch_engine import BatchEngine

pytestmark = pytest.mark.slow

AGENT = Agent(
    **{"torch_threads": 2, "device": "cpu", "algorithm": {"num_mini_batches": 4}, "actor": {}, "critic": {}},
    **{"num_steps_per_env": 24, "max_iterations": 1, "save_interval": 1, "obs_groups": {}},
)


def elsewhere(before: str, *cases: str) -> list[dict]:
    """Return the thread facts that a child process records after some code: one fork for each case."""
    code = f"""{before}
import json, os, sys
from wheelleg_exp.jobs.torch_threads import set_threads, thread_notes
from wheelleg_exp.rl.options import Agent
for case in sys.argv[1:]:
    if os.fork() == 0:
        exec(case)
        found = set_threads({AGENT!r}, 1, samples=12288)
        print(json.dumps({{**found, "notes": thread_notes(found)}}), flush=True)
        os._exit(0)
    os.wait()
"""
    environ = {k: v for k, v in os.environ.items() if k not in cores.VARIABLES}
    command = [sys.executable, "-c", code, *cases]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_normal_start_is_in_force_and_prints_nothing():
    (found,) = elsewhere("from wheelleg_exp.machine import prepare_threads; prepare_threads()", "")
    assert (found["torch"], found["physics"], found["variables_in_time"]) == (2, 1, True)
    assert found["mkl"]["strict"] is True
    assert (found["independent"], found["notes"]) == (True, [])


def test_torch_imported_before_is_in_time_for_mkl_unless_it_multiplied_or_the_user_chose_a_mode():
    modes = "COMPATIBLE,STRICT", "AVX2"
    users = [f"os.environ.update(MKL_CBWR={mode!r}, OMP_WAIT_POLICY='PASSIVE')" for mode in modes]
    found, late, *chosen = elsewhere("import torch", "", "torch.rand(9, 9) @ torch.rand(9, 9)", *users)
    assert found["variables_in_time"] is False
    assert (found["mkl"]["strict"], found["independent"]) == (True, True)
    assert [note for note in found["notes"] if "OMP_WAIT_POLICY" in note]
    assert (late["mkl"]["strict"], late["independent"]) == (False, False)
    assert "MKL is not in its repeatable mode" in late["notes"][0]
    for mode, told in zip(modes, chosen, strict=True):
        assert told["independent"] is False
        assert f"MKL_CBWR is {mode}" in told["notes"][0]


def test_the_gpu_of_the_run_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: f"name of {device}")
    assert set_threads(AGENT, 1, physics_device="cuda:1")["gpu"] == "name of cuda:1"
    assert set_threads(replace(AGENT, device="cuda:2"), 1, physics_device="cuda:1")["gpu"] == "name of cuda:2"
    assert "gpu" not in set_threads(AGENT, 1)


def test_without_mkl_no_promise_is_made(monkeypatch):
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: False)
    found = set_threads(AGENT, 1)
    assert found["mkl"] is None
    assert "no MKL" in thread_notes(found)[0]


def test_large_minibatches_are_reported_because_torch_splits_their_sums():
    assert set_threads(AGENT, 1, samples=4 * SPLIT_ABOVE)["independent"]
    found = set_threads(AGENT, 1, samples=4 * (SPLIT_ABOVE + 1))
    assert not found["independent"]
    assert f"a minibatch has {SPLIT_ABOVE + 1} samples" in thread_notes(found)[0]


def test_a_sum_of_one_thread_is_the_same_at_any_number_of_threads():
    numbers = torch.randn(40 * SPLIT_ABOVE, generator=torch.Generator().manual_seed(1))
    plain, single = set(), set()
    for count in (1, 2, 3, 4):
        torch.set_num_threads(count)
        plain.add(numbers.sum().item())
        with one_thread():
            single.add(numbers.sum().item())
        assert torch.get_num_threads() == count
    assert len(single) == 1
    assert len(plain) > 1, "torch no longer splits sums: the remedy can go"
    small = numbers[:SPLIT_ABOVE]
    assert len({(torch.set_num_threads(count), small.mean().item())[1] for count in (1, 2, 3, 4)}) == 1


def test_the_arithmetic_is_recorded_as_it_is():
    before = torch_threads.numerics()
    assert (before["rounds_to_nearest"], before["keeps_denormals"], before["default_dtype"]) == (True, True, "float32")
    assert any("Math Kernel" in line or "BLAS" in line for line in before["libraries"])

    changes = {
        "default_dtype": (torch.set_default_dtype, torch.float64, torch.float32),
        "deterministic_algorithms": (torch.use_deterministic_algorithms, True, False),
    }
    for name, (change, other, usual) in changes.items():
        change(other)
        try:
            after = torch_threads.numerics()
        finally:
            change(usual)
        assert after[name] != before[name], name
    assert torch_threads.numerics() == before


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system binds no process to cores")
def test_cores_that_a_process_may_not_run_on_do_not_count():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert cores.usable_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert 1 <= cores.usable_cores() <= len(allowed)


def test_one_core_is_one_physics_thread(monkeypatch):
    ball = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(ball)
    monkeypatch.setattr("wheelleg_exp.sim.batch_engine.usable_cores", lambda: 1)
    assert (BatchEngine(model, 2, 0).nthread, BatchEngine(model, 2, 2).nthread) == (1, 2)


@pytest.mark.parametrize("threads_now", [2, 3, 4, 5])
def test_activations_that_threads_split_within_a_vector_are_reported(threads_now):
    layer = {"hidden_dims": [512, 100], "activation": "elu"}
    agent = replace(AGENT, torch_threads=threads_now, actor=layer)
    told = {}
    for envs in (333, 512):
        found = set_threads(agent, 1, samples=24 * envs)
        told[envs] = [reason for reason in found["dependent_because"] if "activations" in reason]
        assert found["independent"] == (not told[envs])
        for rows, width in ((envs, 512), (envs, 100), (24 * envs // 4, 512), (24 * envs // 4, 100)):
            numbers = torch.randn(rows, width, generator=torch.Generator().manual_seed(1))
            one, more = (
                (torch.set_num_threads(count), torch.nn.functional.elu(numbers))[1] for count in (1, threads_now)
            )
            assert torch.equal(one, more) or f"{rows} x {width}" in told[envs][0]
    assert bool(told[333]) or threads_now == 2
    assert bool(told[512]) == (threads_now not in (2, 4))
    assert set_threads(replace(agent, actor={**layer, "activation": "relu"}), 1, samples=24 * 333)["independent"]


XEON = "processor\t: 0\nvendor_id\t: GenuineIntel\nflags\t\t: fpu avx2 avx512f avx512dq avx512cd avx512bw avx512vl\n\n"


@pytest.mark.parametrize(
    ("text", "kernels"),
    [
        (XEON, "AVX512,STRICT"),
        (XEON.replace("GenuineIntel", "AuthenticAMD"), "AVX2,STRICT"),
        (XEON.replace(" avx512bw", "").rstrip("\n") + "\n\n" + XEON, "AVX2,STRICT"),  # the first processor counts
        (None, "AVX2,STRICT"),
    ],
)
def test_wide_kernels_are_for_intels_cpus_that_have_them(tmp_path, monkeypatch, text, kernels):
    if text is not None:
        (tmp_path / "cpuinfo").write_text(text)
    monkeypatch.setattr(cores, "_CPUINFO", tmp_path / "cpuinfo")
    assert cores.matrix_kernels() == kernels


@pytest.mark.parametrize(
    ("users", "recorded", "found"),
    [
        (None, "AVX2,STRICT", "AVX2,STRICT"),
        (None, "AVX512_E1,STRICT", "AVX512,STRICT"),
        (None, None, "AVX512,STRICT"),
        ("SSE4_2", "AVX2,STRICT", "SSE4_2"),
    ],
)
def test_a_run_resumes_with_its_kernels_unless_the_user_sets_others(monkeypatch, users, recorded, found):
    monkeypatch.setattr(cores, "_chosen", set())
    monkeypatch.setattr(cores, "matrix_kernels", lambda: "AVX512,STRICT")
    monkeypatch.setattr(cores, "VARIABLES", {"MKL_CBWR": lambda: "AVX512,STRICT"})
    monkeypatch.setenv("MKL_CBWR", users or "")
    if users is None:
        monkeypatch.delenv("MKL_CBWR")
    cores.prepare_threads()
    assert ("MKL_CBWR" in cores.own_environ()) == (users is not None)
    cores.keep_kernels({} if recorded is None else {"MKL_CBWR": recorded})
    assert os.environ["MKL_CBWR"] == found


FIRST_USE = """
import os, sys
from wheelleg_exp import machine
def keep_kernels(recorded):
    print(recorded["MKL_CBWR"], "tensordict" in sys.modules, flush=True)
    os._exit(7)
machine.keep_kernels = keep_kernels
from wheelleg_exp.cli.main import main
main(["resume", sys.argv[1]])
"""


def test_a_resume_asks_for_the_runs_kernels_before_anything_uses_them(tmp_path, monkeypatch):
    run = tmp_path / "stand" / "2026-01-01_00-00-00_0"
    run.mkdir(parents=True)
    monkeypatch.setenv("MKL_CBWR", "AVX2,STRICT")
    Manifest.begin(run, task="stand", seed=0, command=[], threads={})
    command = [sys.executable, "-c", FIRST_USE, str(run)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (said.stdout, said.returncode) == ("AVX2,STRICT False\n", 7), said.stderr


@pytest.mark.parametrize(("running", "found"), [("1/300", "20000"), ("3/300", "20000"), ("4/300", "0"), ("?", "0")])
def test_threads_spin_only_where_cores_are_left(monkeypatch, tmp_path, running, found):
    (tmp_path / "loadavg").write_text(f"0.5 0.5 0.5 {running} 4711\n")
    monkeypatch.setattr(cores, "_LOADAVG", tmp_path / "loadavg")
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert cores.spins() == found
    monkeypatch.setattr(cores, "_LOADAVG", tmp_path / "none")
    assert cores.spins() == "0"


@pytest.mark.parametrize(("chosen", "found"), [({"GOMP_SPINCOUNT"}, "0"), (set(), "777")])
def test_parallel_processes_sleep_at_once_unless_the_user_sets_it(monkeypatch, chosen, found):
    monkeypatch.setattr(cores, "_chosen", chosen)
    monkeypatch.setenv("GOMP_SPINCOUNT", "777")
    cores.share_cores()
    assert os.environ["GOMP_SPINCOUNT"] == found
