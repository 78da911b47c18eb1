"""The facts besides the source on which a run's numbers depend: distributions, hardware, environment variables."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import wheelleg_exp
from wheelleg_exp.machine import first_processor, usable_cores
from wheelleg_exp.run.git_commands import without_credentials

# The Python packages whose versions can change a run's numbers or files.
_DISTRIBUTIONS = (
    *("mujoco-core", "torch", "rsl-rl-lib", "numpy", "tensordict", "gymnasium", "hydra-core"),
    *("omegaconf", "usd-core", "rerun-sdk", "tensorboard", "onnx", "mujoco-warp", "warp-lang"),
)

# The prefixes of environment variables that change computed numbers or the number of threads.
_NUMERICAL = (
    *("MKL", "OMP", "GOMP", "KMP", "TBB", "OPENBLAS", "GOTO", "BLIS", "VECLIB", "NUMEXPR", "NPY", "NUMPY", "GLIBC"),
    *("ATEN", "ONEDNN", "DNNL", "TORCH", "PYTORCH", "TENSORDICT", "CUBLAS"),
)
# The prefixes of environment variables that select the devices or the code that a process uses.
_OF_MACHINE = (
    *("TRITON", "RSL_RL", "CUDA", "CUDNN", "NVIDIA", "NCCL", "HIP", "ROCR", "HSA"),
    *("MUJOCO", "PXR", "USD", "WHEELLEG", "PYTHON", "LC"),
)
_NUMERIC = re.compile(rf"({'|'.join(_NUMERICAL)})_\w+|PYTHONHASHSEED")
_VARIABLES = re.compile(
    rf"({'|'.join(_NUMERICAL + _OF_MACHINE)})_\w+|PYTHON[A-Z]+|LANG|LD_(PRELOAD|LIBRARY_PATH|BIND_NOW)|DYLD_\w+"
)

# Do not store an environment variable whose name contains a word such as TOKEN, because its value can be a secret.
_SECRET = re.compile(r"TOKEN|SECRET|PASSW|CREDENTIAL|(API|ACCESS|AUTH|PRIVATE)_?KEY")

_REQUESTED = re.compile(r"\$\{\s*oc\.env\s*:\s*([A-Za-z_]\w*)")

_CPU_FLAGS = re.compile(r"(avx|fma|amx|f16c|sse4|bf16|asimd|sve)\w*")


def versions() -> dict[str, str | None]:
    """Return the versions of Python and of the packages that affect a run; None for a package that is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version(), "wheelleg_exp": wheelleg_exp.__version__}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def hardware() -> dict[str, object]:
    """Return the CPU's model and vector instructions, the number of CPU cores, the memory size, and the platform.

    ``cores_usable`` counts the cores of this container; ``torch_cpu_capability`` exists only if torch is imported.
    """
    memory = None
    with suppress(OSError):
        memory = re.search(r"^MemTotal:\s+(\d+) kB", Path("/proc/meminfo").read_text(errors="replace"), re.MULTILINE)
    facts: dict[str, object] = {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "cores_usable": usable_cores(),
        "memory_gib": round(int(memory.group(1)) / 2**20, 1) if memory else None,
        "machine": platform.machine(),
        "platform": platform.platform(),
        "python_implementation": platform.python_implementation(),
    }
    facts.update(_cpu_facts())
    torch = sys.modules.get("torch")
    if torch is not None:
        facts["torch_cpu_capability"] = torch.backends.cpu.get_cpu_capability()
    return facts


def variables(environ: Mapping[str, str] | None = None, also: Iterable[str] = ()) -> dict[str, str]:
    """Return the environment variables that can change the results of a run, sorted by name.

    ``also`` adds names. Variables whose names contain a word such as ``TOKEN`` or ``PASSW`` are left out.
    """
    environ = os.environ if environ is None else environ
    wanted = set(also)
    chosen = [k for k in sorted(environ) if _VARIABLES.fullmatch(k) or k in wanted]
    return {k: environ[k] for k in chosen if not _SECRET.search(k)}


def replay_environ(
    recorded: Mapping[str, str], environ: Mapping[str, str] | None = None, also: Collection[str] = ()
) -> dict[str, str]:
    """Return environment variables with which a new process computes the same numbers as a recorded run.

    Variables that affect numbers, such as ``OMP_NUM_THREADS``, get their recorded values, or are removed without one;
    those in ``also`` get their recorded values. Paths, devices, and preloaded libraries keep their present values.
    """
    present = dict(os.environ if environ is None else environ)
    unchanged = {name: value for name, value in present.items() if not _is_numeric(name, value)}
    return unchanged | {name: value for name, value in recorded.items() if _is_numeric(name, value) or name in also}


def _is_numeric(name: str, value: str) -> bool:
    return _NUMERIC.fullmatch(name) is not None and not value.startswith(("/", "~"))


def requested_variables(texts: Iterable[str]) -> list[str]:
    """Return the sorted names of the environment variables that configs request with ``${oc.env:NAME}``."""
    return sorted({name for text in texts for name in _REQUESTED.findall(text)})


def distributions() -> list[str]:
    """Return ``name==version`` of every installed distribution, sorted, including local version labels."""
    # For a package that was not installed from a package index, write a comment with the package's origin.
    found: dict[str, str] = {}
    for distribution in metadata.distributions():
        # Read only the header of each package's metadata, because parsing the descriptions of 100 packages takes 1 s.
        text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
        head = dict(re.findall(r"^(Name|Version): *(\S+)", text.split("\n\n", 1)[0], re.MULTILINE))
        if "Name" in head:  # A broken installation of a package can lack metadata.
            key = re.sub(r"[-_.]+", "-", head["Name"]).lower()
            # If a package is installed twice, keep the first one on ``sys.path``, because Python imports this one.
            found.setdefault(key, f"{head['Name']}=={head.get('Version', '')}{_origin(distribution)}")
    return [found[key] for key in sorted(found)]


def environment_text(threads: Mapping[str, object]) -> str:
    """Return ``environment.txt``: the machine's facts as comments, then the distributions as requirements for pip."""
    sections: dict[str, Mapping[str, object]] = {
        "python": {"version": sys.version.replace("\n", " ")},
        "hardware": {k: v for k, v in hardware().items() if k != "torch_cpu_capability"},
        "threads": threads,
        "environment variables": variables(),
    }
    lines: list[str] = []
    for title, facts in sections.items():
        lines.append(f"# {title}")
        for key, value in facts.items():
            text = " ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
            lines.append(f"#   {key}: {' '.join(text.splitlines())}")
        lines += [] if facts else ["#   none"]
    return "\n".join([*lines, *distributions()]) + "\n"


def _origin(distribution: metadata.Distribution) -> str:
    """Return a comment that names the folder, archive, or repository from which a package was installed (PEP 610)."""
    text = distribution.read_text("direct_url.json")
    if not text:
        return ""
    try:
        origin = json.loads(text)
        url = without_credentials(str(origin["url"]))
        commit = origin.get("vcs_info", {}).get("commit_id")
        editable = origin.get("dir_info", {}).get("editable", False)
    except (ValueError, KeyError, TypeError, AttributeError):
        return ""
    parts = ["editable"] if editable else []
    return "  # " + " ".join([*parts, url, *([commit] if commit else [])])


def _cpu_facts() -> dict[str, object]:
    if sys.platform == "darwin":
        command = ("sysctl", "-n", "machdep.cpu.brand_string")
        with suppress(OSError, subprocess.TimeoutExpired):
            name = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
            return {"cpu": name} if name else {}
        return {}
    block = first_processor()
    names = {"model name": "cpu", "cpu family": "cpu_family", "model": "cpu_model", "stepping": "cpu_stepping"}
    facts: dict[str, object] = {new: block[old] for old, new in names.items() if block.get(old)}
    flags = block.get("flags") or block.get("Features") or ""
    chosen = sorted({flag for flag in flags.split() if _CPU_FLAGS.fullmatch(flag) or "bf16" in flag})
    return {**facts, "cpu_flags": chosen} if chosen else facts
