"""Set torch's thread count, and collect settings of threads and rounding for a run's manifest."""

from __future__ import annotations

import ctypes
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch

from wheelleg_exp.machine import prepare_threads
from wheelleg_exp.rl.determinism import SPLIT_ABOVE
from wheelleg_exp.rl.matmul import chosen_matmul, products_depend_on_threads
from wheelleg_exp.rl.options import Learning

# The names of MKL's code branches, ordered by their numbers in mkl_types.h (MKL_CBWR_*).
_NAMES = "off auto compatible sse2 5 ssse3 sse4_1 sse4_2 avx avx2 avx512_mic avx512 avx512_mic_e1 avx512_e1"
_BRANCHES = dict(enumerate(_NAMES.split(), start=1))
_in_time: list[bool] = []  # An entry is False if environment variables were set too late, after torch was imported.

_LIBRARY = re.compile("Math Kernel Library|MKL-DNN|oneDNN|OpenMP|LAPACK|OpenBLAS|Compute Library")
_STRICT = 0x10000
_EVERYTHING = -1
_VECTOR_STEP = 32  # One step of a vector loop in torch computes 32 numbers, which are two AVX-512 vectors.
# With MKL_CBWR=OFF or COMPATIBLE, matrix products depend on the thread count, even with the option STRICT.
_THREADED_BRANCHES = ("off", "compatible")


class Mkl(TypedDict):
    """MKL's code branch, and whether MKL's strict mode is on; None if MKL does not report its mode."""

    branch: str | None
    strict: bool | None


def set_threads(
    agent: Learning, physics_threads: int, *, samples: int | None = None, physics_device: str = "cpu"
) -> dict[str, object]:
    """Set torch's thread count to ``agent.torch_threads``; return thread and rounding settings for a run's manifest.

    ``samples`` is the number of environment steps in one rollout; None if nothing is trained. ``independent`` is true
    if results do not depend on the thread count; else ``dependent_because`` lists the reasons.
    """
    wanted = agent.torch_threads
    _in_time.append(prepare_threads())  # MKL and OpenMP read environment variables only at their first use.
    torch.set_num_threads(wanted)
    mkl, device = mkl_in_force(), agent.device
    reasons = _thread_dependence(mkl, device, _largest_mean(agent, samples))
    reasons += _uneven_activations(agent, samples, wanted)
    return {
        "torch": torch.get_num_threads(),
        "interop": torch.get_num_interop_threads(),
        "physics": physics_threads,
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "device": device,
        **_gpu_facts(device, physics_device),
        "variables_in_time": all(_in_time),
        "mkl": mkl,
        "matmul": chosen_matmul(agent),
        "numerics": numerics(),
        "independent": not reasons,
        "dependent_because": reasons,
    }


def dependent_products(
    networks: Iterable[torch.nn.Module], agent: Learning, samples: int, threads: Mapping[str, Any]
) -> dict[str, object]:
    """Return manifest entries on bfloat16 products that depend on the thread count, or {} if they do not."""
    rows = max(1, _largest_mean(agent, samples))
    if threads["matmul"] != "bfloat16" or not products_depend_on_threads(networks, rows, int(threads["torch"])):
        return {}
    reason = "oneDNN splits sums of bfloat16 products among threads on this CPU; agent.matmul=float32 does not"
    return {"independent": False, "dependent_because": [*threads["dependent_because"], reason]}


def thread_notes(threads: Mapping[str, Any]) -> list[str]:
    """Return warnings about the torch threads of a run, one line each."""
    count = threads["torch"]
    reasons = threads.get("dependent_because") or []
    notes = [f"warning: the number of torch's threads ({count}) is part of this result: {reason}" for reason in reasons]
    if count > 1 and not threads.get("variables_in_time", True):
        notes.append("warning: torch was imported before OMP_WAIT_POLICY was set: its threads spin on a busy machine")
    return notes


def mkl_in_force() -> Mkl | None:
    """Return MKL's branch and strict mode, which environment variables cannot change any more; None without MKL."""
    has_mkl: Callable[[], bool] = torch.backends.mkl.is_available  # torch does not annotate this function.
    if not has_mkl():
        return None
    library = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    try:
        code = int(ctypes.CDLL(str(library)).mkl_serv_cbwr_get(ctypes.c_int(_EVERYTHING)))
    except (OSError, AttributeError):
        return Mkl(branch=None, strict=None)
    return Mkl(branch=_BRANCHES.get(code & ~_STRICT, str(code & ~_STRICT)), strict=bool(code & _STRICT))


def numerics() -> dict[str, object]:
    """Return those settings of torch and of the processor that change floating-point results."""
    has_onednn: Callable[[], bool] = torch.backends.mkldnn.is_available
    tiny, one = np.float64(2.0**-1070), np.float64(1.0)
    with np.errstate(all="ignore"):
        to_nearest = one + 2.0**-53 == one and -one - 2.0**-53 == -one and one + 2.0**-52 * 0.75 > one
        keeps_tiny = tiny * one > 0.0
    lines = [line.strip(" -") for line in torch.__config__.show().splitlines()]
    return {
        "libraries": [line for line in lines if _LIBRARY.search(line) and not line.startswith("Build settings")],
        "mkldnn": has_onednn() and torch.backends.mkldnn.enabled,
        "matmul_precision": torch.get_float32_matmul_precision(),
        "default_dtype": str(torch.get_default_dtype()).removeprefix("torch."),
        "deterministic_algorithms": torch.are_deterministic_algorithms_enabled(),
        "rounds_to_nearest": bool(to_nearest),
        "keeps_denormals": bool(keeps_tiny) and (torch.tensor(1e-40) * 1.0).item() > 0.0,
    }


_DRIVER = Path("/proc/driver/nvidia/version")


def _gpu_facts(*devices: str) -> dict[str, object]:
    """Return the model and the driver version of the first GPU among the devices of a run; {} without a GPU."""
    gpus = [device for device in devices if device.startswith("cuda")]
    if not gpus or not torch.cuda.is_initialized():
        return {}
    text = _DRIVER.read_text(encoding="utf-8", errors="replace") if _DRIVER.is_file() else ""
    version = re.search(r"\d+(\.\d+)+", text)
    return {"gpu": torch.cuda.get_device_name(gpus[0]), "gpu_driver": version and version[0]}


def _largest_mean(agent: Learning, samples: int | None) -> int:
    """Return the largest number of samples over which the PPO update computes a mean."""
    return (samples or 0) // max(1, int(agent.algorithm.get("num_mini_batches", 1)))


def _uneven_activations(agent: Learning, samples: int | None, threads: int) -> list[str]:
    """Return a warning about network activations whose rounding depends on the number of threads."""
    # Rounding depends on the thread count if a thread computes a number of values that is not a multiple of 32.
    if samples is None or agent.device != "cpu":
        return []
    batches = {samples // agent.num_steps_per_env, _largest_mean(agent, samples)}
    elus = [section for section in agent.networks.values() if str(section.get("activation", "elu")) == "elu"]
    layers = {int(width) for section in elus for width in section.get("hidden_dims") or ()}
    uneven = []
    for rows, width in product(sorted(batches), sorted(layers)):
        parts = min(threads, math.ceil(rows * width / SPLIT_ABOVE))  # torch splits an array into chunks of equal size.
        if parts > 1 and math.ceil(rows * width / parts) % _VECTOR_STEP != 0:
            uneven.append(f"{rows} x {width}")
    if not uneven:
        return []
    text = f"torch splits the activations of {', '.join(uneven)} numbers into {threads} parts that end "
    return [text + "within a vector; 1, 2, 4 or 8 threads and a multiple of 32 environments do not"]


def _thread_dependence(mkl: Mkl | None, device: str, largest_mean: int) -> list[str]:
    reasons = []
    if device != "cpu":
        reasons.append(f"the networks are on {device}")
    if mkl is None:
        reasons.append("this torch has no MKL, and other libraries make no promise about threads")
    elif not mkl["strict"] or mkl["branch"] in _THREADED_BRANCHES:
        variable = os.environ.get("MKL_CBWR", "not set")
        state = f"{mkl['branch']}{', strict' if mkl['strict'] else ', not strict'}"
        need = "it must be AVX2,STRICT or the like before torch multiplies its first matrices"
        reasons.append(f"MKL is not in its repeatable mode (it is {state}; MKL_CBWR is {variable}; {need})")
    if largest_mean > SPLIT_ABOVE:
        hint = "a higher agent.algorithm.num_mini_batches makes it smaller"
        size = f"a minibatch has {largest_mean} samples; {hint}"
        reasons.append(f"torch adds up more than {SPLIT_ABOVE} numbers in parts, one a thread, and {size}")
    return reasons
