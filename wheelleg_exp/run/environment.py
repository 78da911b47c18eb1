"""What the numbers depend on apart from the source: distributions, hardware, and environment variables.

This module imports neither torch nor MuJoCo. Versions come from the installed metadata.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import wheelleg_exp
from wheelleg_exp.machine import first_processor, usable_cores
from wheelleg_exp.run.git_commands import without_credentials

# Distributions whose version can change a number or a file of a run.
_DISTRIBUTIONS = (
    "wheelleg_exp",
    "mujoco",
    "torch",
    "rsl-rl-lib",
    "numpy",
    "tensordict",
    "gymnasium",
    "hydra-core",
    "omegaconf",
    "usd-core",
    "rerun-sdk",
    "tensorboard",
    "onnx",
)

# Prefixes of variables that change numbers or threads; then of those that choose devices, code, or how code runs.
_NUMERICAL = (
    *("MKL", "OMP", "GOMP", "KMP", "TBB", "OPENBLAS", "GOTO", "BLIS", "VECLIB", "NUMEXPR", "NPY", "NUMPY", "GLIBC"),
    *("ATEN", "ONEDNN", "DNNL", "TORCH", "PYTORCH", "TENSORDICT", "CUBLAS"),
)
_OF_MACHINE = (
    *("TRITON", "RSL_RL", "CUDA", "CUDNN", "NVIDIA", "NCCL", "HIP", "ROCR", "HSA"),
    *("MUJOCO", "PXR", "USD", "WHEELLEG", "PYTHON", "LC"),
)
_NUMERIC = re.compile(rf"({'|'.join(_NUMERICAL)})_\w+|PYTHONHASHSEED")
_VARIABLES = re.compile(
    rf"({'|'.join(_NUMERICAL + _OF_MACHINE)})_\w+|PYTHON[A-Z]+|LANG|LD_(PRELOAD|LIBRARY_PATH|BIND_NOW)|DYLD_\w+"
)

# Their values are not stored, because NVIDIA_API_KEY would match the patterns above.
_SECRET = re.compile(r"TOKEN|SECRET|PASSW|CREDENTIAL|(API|ACCESS|AUTH|PRIVATE)_?KEY")

_REQUESTED = re.compile(r"\$\{\s*oc\.env\s*:\s*([A-Za-z_]\w*)")

_CPU_FLAGS = re.compile(r"(avx|fma|amx|f16c|sse4|bf16|asimd|sve)\w*")


def versions() -> dict[str, str | None]:
    """Return the versions of Python and of the relevant distributions; None for a missing distribution."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    found["wheelleg_exp"] = found["wheelleg_exp"] or wheelleg_exp.__version__
    return found


def hardware() -> dict[str, Any]:
    """Return the CPU's model, its vector instructions, cores and memory, and the platform.

    ``cores_usable`` is the number of cores that this process can use, within the limit of a container.
    ``torch_cpu_capability`` exists only if torch is already imported.
    """
    facts: dict[str, Any] = {
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "cores_usable": usable_cores(),
        "memory_gib": _memory_gib(),
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
    """Return the environment variables that can change results, sorted; a variable named like a secret is left out.

    Args:
        environ: the variables; those of the process by default.
        also: more names, such as those that a config requests.
    """
    environ = os.environ if environ is None else environ
    wanted = set(also)
    chosen = [k for k in sorted(environ) if _VARIABLES.fullmatch(k) or k in wanted]
    return {k: environ[k] for k in chosen if not _SECRET.search(k)}


def replay_environ(
    recorded: Mapping[str, str], environ: Mapping[str, str] | None = None, also: Collection[str] = ()
) -> dict[str, str]:
    """Return the environment for a process that must compute the same numbers as a run.

    Variables that change numbers have the run's values, and are unset where the run did not have them. Other variables
    keep their present values: paths, devices, preloaded libraries.

    Args:
        recorded: the variables in the run's manifest.
        environ: the present environment; that of this process by default.
        also: more names whose values are taken from the run, such as those that its config requests.
    """
    present = dict(os.environ if environ is None else environ)
    unchanged = {name: value for name, value in present.items() if not _is_numeric(name, value)}
    taken = {name: value for name, value in recorded.items() if _is_numeric(name, value) or name in also}
    return unchanged | taken


def _is_numeric(name: str, value: str) -> bool:
    return _NUMERIC.fullmatch(name) is not None and not value.startswith(("/", "~"))


def requested_variables(texts: Iterable[str]) -> list[str]:
    """Return the sorted names of the environment variables that configs request with ``${oc.env:NAME}``."""
    return sorted({name for text in texts for name in _REQUESTED.findall(text)})


def distributions() -> list[str]:
    """Return ``name==version`` of every installed distribution, sorted, including local version labels.

    A distribution that was not installed from an index has a comment with its origin.
    """
    found: dict[str, str] = {}
    for distribution in metadata.distributions():
        name, version = _name_and_version(distribution)
        if not name:
            continue  # a folder without metadata, left by a broken installation
        key = re.sub(r"[-_.]+", "-", name).lower()
        # Python imports the first one on the path.
        found.setdefault(key, f"{name}=={version}{_origin(distribution)}")
    return [found[key] for key in sorted(found)]


def _name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    """Return both from the head of the metadata; parsing the descriptions of 100 distributions would take a second."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    head = dict(re.findall(r"^(Name|Version): *(\S+)", text.split("\n\n", 1)[0], re.MULTILINE))
    return head.get("Name", ""), head.get("Version", "")


def environment_text(threads: Mapping[str, Any]) -> str:
    """Return the text of ``environment.txt``: the machine's facts as comments, then the distributions.

    pip can read the text as a requirements file. Equal environments give equal texts.

    Args:
        threads: the thread policy of the run.
    """
    sections: dict[str, Mapping[str, Any]] = {
        "python": {"version": sys.version.replace("\n", " ")},
        "hardware": {k: v for k, v in hardware().items() if k != "torch_cpu_capability"},
        "threads": threads,
        "environment variables": variables(),
    }
    lines: list[str] = []
    for title, facts in sections.items():
        lines.append(f"# {title}")
        lines += [f"#   {key}: {_one_line(value)}" for key, value in facts.items()] or ["#   none"]
    return "\n".join([*lines, *distributions()]) + "\n"


def _one_line(value: Any) -> str:
    text = " ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    return " ".join(text.splitlines())


def _origin(distribution: metadata.Distribution) -> str:
    """Return a comment for a distribution installed from a folder, an archive or a repository (PEP 610)."""
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


def _cpu_facts() -> dict[str, Any]:
    """Return model, family, stepping and vector instructions of the CPU."""
    if sys.platform == "darwin":
        name = _output("sysctl", "-n", "machdep.cpu.brand_string")
        return {"cpu": name} if name else {}
    block = first_processor()
    facts: dict[str, Any] = {}
    names = {
        "model name": "cpu",
        "cpu family": "cpu_family",
        "model": "cpu_model",
        "stepping": "cpu_stepping",
    }
    facts.update({new: block[old] for old, new in names.items() if block.get(old)})
    flags = block.get("flags") or block.get("Features") or ""
    chosen = sorted({flag for flag in flags.split() if _CPU_FLAGS.fullmatch(flag) or "bf16" in flag})
    return {**facts, "cpu_flags": chosen} if chosen else facts


def _memory_gib() -> float | None:
    match = re.search(r"^MemTotal:\s+(\d+) kB", _read("/proc/meminfo"), re.MULTILINE)
    return round(int(match.group(1)) / 2**20, 1) if match else None


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""
