"""List the differences of two runs in settings, robot, code, versions, hardware, threads, and environment variables.

Another CPU or another version of PyTorch *allows* unequal numbers in two runs, because rounding errors can change.
Different settings or another number of physics threads do not allow unequal numbers. Different code *forbids* a
comparison within tolerance, because no test can separate the effects of code from rounding errors.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from wheelleg_exp.config.explaining.config_diff import ABSENT, Change, changes, same
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_bytes, sha256
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.records import ProcessFacts, Resume
from wheelleg_exp.run.run_config import ROBOT, load_params, recorded_robot, written_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_changes import SourceRecord, describe_changes, first_few
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.terms.key_syntax import Keys

# ``_HARMLESS`` settings change files, speed, or buffer sizes, but no computed number.
_HARMLESS: tuple[Keys, ...] = (
    *(("agent", key) for key in ("max_iterations", "save_interval", "max_non_finite", "torch_threads", "logger")),
    *(("env", "sim", key) for key in ("nthread", "nconmax", "njmax", "graph")),
    # Terms refer to these names and sizes of the robot, so that each effect is a difference of a term, too.
    *(("env", "robot", key) for key in ("joint_sets", "body_sets", "standing_height", "wheel_radius")),
    ("recording",),
)


def decides(keys: Keys) -> bool:
    """Return whether a setting, given by its config path, can change a computed number of the training."""
    return not any(keys[: len(harmless)] == harmless for harmless in _HARMLESS)


def plain_changes(a: object, b: object, keys: Keys = ()) -> list[Change]:
    """Return how two nested mappings differ: in values, compared bit for bit, and in the order of inner mappings."""
    return [*changes(a, b, _same, keys), *_reordered(keys, a, b)]


def as_dict(change: Change) -> dict[str, object]:
    """Return a JSON document that describes a setting that differs between two runs."""
    # JSON has no value for a missing key, so write a missing value as text.
    a, b = (str(value) if value is ABSENT else value for value in (change.a, change.b))
    return {"key": change.key, "a": a, "b": b, "decides": decides(change.keys)}


def changes_text(changes: Sequence[Change]) -> str:
    """Return a text that lists the settings that differ between two runs, with the values of the first few settings."""
    return first_few([f"{change.key} ({brief(change.a)} and {brief(change.b)})" for change in changes])


def brief(value: object) -> str:
    """Return a config value as one short line of text; shorten a manager term to the name of its function or class."""
    if isinstance(value, Mapping) and "_target_" in value:
        value = str(value["_target_"]).rsplit(".", 1)[-1]
    written = repr(value) if isinstance(value, float) else str(value)
    return written if len(written) <= _WIDEST else written[: _WIDEST - 1] + "…"


def settings_of(run: RunDirectory) -> dict[str, object]:
    """Return the settings of a run, and those settings that its resumes changed and that can change a number."""
    env, agent = load_params(run)
    facts = run.manifest().facts
    resumes = []
    for entry in facts.resumes:
        now = {change.get("key", ""): change.get("now") for change in entry.changes}
        if decisive := {key: value for key, value in now.items() if decides(tuple(key.split(".")))}:
            resumes.append([entry.iteration, decisive])
    settings: dict[str, object] = {"seed": list(facts.seeds), "task": facts.task, "env": env, "agent": agent}
    settings["resumed with other settings"] = resumes
    config = written_config(run)
    return {**settings, "recording": config["recording"]} if "recording" in config else settings


def robot_of(run: RunDirectory) -> dict[str, object]:
    """Return the digests of a run's robot: its source files, the generated MJCF, and the compiled model."""
    mjcf = run.asset / "robot.xml"
    try:
        known = recorded_robot(run) if (run.path / ROBOT).is_file() else None
        digest = sha256(mjcf) if mjcf.is_file() else None
    except RunDirectoryError as error:
        return {"damaged": str(error)}
    sources, model = (known.sources, known.model_sha256) if known else (None, None)
    return {"sources": sources, "robot.xml": digest, "compiled model": model}


def _reordered(keys: Keys, a: object, b: object) -> Iterator[Change]:
    if not (isinstance(a, Mapping) and isinstance(b, Mapping)):
        return
    ones, others = ([name for name in x if name in y and isinstance(x[name], Mapping)] for x, y in ((a, b), (b, a)))
    if ones != others and sorted(map(str, ones)) == sorted(map(str, others)):
        yield Change((*keys[:-1], f"{keys[-1] if keys else ''} (order)"), ones, others)
    for name in ones:
        yield from _reordered((*keys, str(name)), a[name], b[name])


def _same(a: object, b: object) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b) or (a != a and b != b)
    return same(a, b)


SECTIONS = ("versions", "modules", "hardware", "threads", "environment_variables")
MUJOCO = "mujoco-core"  # the package that contains the physics engine
_WIDEST = 40  # In a text that compares two runs, a config value has at most 40 characters.
UNKNOWN_CODE = "files, not recorded"
_CODE = ("status", "commit", "tree", "dirty", "patch_sha256", "content_sha256")

_KERNEL_VARIABLES = (
    *("MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "MKL_DEBUG_CPU_TYPE", "ATEN_CPU_CAPABILITY"),
    *("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA", "OPENBLAS_CORETYPE"),
)
_ALLOWING: dict[str, dict[str, str]] = {
    "hardware": {
        **dict.fromkeys(("cpu", "cpu_family", "cpu_model"), "another CPU"),
        **dict.fromkeys(("cpu_flags", "torch_cpu_capability"), "other vector instructions"),
        "machine": "another CPU architecture",
        "platform": "another C library (sine, cosine, exponential)",
    },
    "versions": {name: f"another {name}" for name in ("torch", MUJOCO, "numpy")},
    "threads": {
        "cpu_capability": "other vector instructions",
        **dict.fromkeys(("device", "gpu", "gpu_driver"), "another device or driver"),
        "mkl": "other kernels of the matrix library",
        "matmul": "other products in the update (agent.matmul)",
    },
    "environment_variables": dict.fromkeys(_KERNEL_VARIABLES, "other kernels of the matrix libraries"),
}
_THREADS_OF_TORCH = "another number of torch threads, where that changes sums"

UNKNOWN_BEFORE_TORCH = ("torch_cpu_capability",)  # Torch reports its CPU instruction set only after its import.


@dataclass(frozen=True)
class FactDifference:
    """One recorded fact that differs between two runs."""

    section: str  # The kind of fact that differs, such as ``versions``, ``hardware``, ``code``, or ``resumed``.
    name: str
    a: object  # ``a`` is the fact's value in run A, such as a CPU model; a list if a resume changed the value.
    b: object
    allows: str | None = None  # ``allows`` says why rounding errors can differ, such as ``another CPU``.
    forbids: bool = False  # True if a difference such as other code can change numbers by more than rounding errors.
    note: str = ""  # A text that describes how the source code of two runs differs.


def environment_differences(
    a: Sequence[ProcessFacts], b: Sequence[ProcessFacts], unknown: Collection[str] = ()
) -> list[FactDifference]:
    """Return how the processes of two runs differ in versions, modules, hardware, threads, and environment variables.

    Sections that one run did not record, such as ``hardware``, and facts in ``unknown`` are not compared.
    """
    found = []
    for section in SECTIONS:
        ones, others = _values(a, section), _values(b, section)
        if ones is not None and others is not None:
            for name in sorted({*ones, *others} - set(unknown)):
                one, other = ones.get(name, []), others.get(name, [])
                if one != other and (section not in SECTIONS[:2] or (one and other)):  # A missing module is unknown.
                    x, y = (values[0] if len(values) == 1 else values or None for values in (one, other))
                    allows = _allows(section, name, one, other, (a, b))
                    found.append(FactDifference(section, name, x, y, allows, forbids=section == "modules"))
    return found


def run_differences(a: RunDirectory, b: RunDirectory) -> list[FactDifference]:
    """Return how two runs differ in code, environment, and installed Python packages."""
    one, other = a.manifest(), b.manifest()
    facts = environment_differences(one.facts.processes, other.facts.processes)
    listed = {_normal(difference.name) for difference in facts if difference.section == "versions"}
    ones, others = _installed(a), _installed(b)
    names = sorted({*ones, *others} - listed) if ones and others else []
    facts_of = [(name, ones.get(name), others.get(name)) for name in names]
    more = [FactDifference("distributions", name, one, two) for name, one, two in facts_of if one != two]
    return [*_code_differences(source_of(a, one), source_of(b, other)), *_resume_differences(one, other), *facts, *more]


def _values(processes: Sequence[ProcessFacts], section: str) -> dict[str, list[object]] | None:
    """Return all values of each fact, such as ``cpu``, in the processes that started and resumed a run."""
    tables = [table for process in processes if (table := getattr(process, section)) is not None]
    if section == "versions":  # Old manifests can lack ``mujoco-core``; their metapackage ``mujoco`` has its version.
        tables = [{MUJOCO: table["mujoco"], **table} if "mujoco" in table else table for table in tables]
    values: dict[str, list[object]] = {}
    for name in dict.fromkeys(name for table in tables for name in table if name != "mujoco"):
        for value in (table.get(name) for table in tables):
            if value not in values.setdefault(name, []):
                values[name].append(value)
    return values if tables else None


def _allows(
    section: str, name: str, a: list[object], b: list[object], runs: Iterable[Sequence[ProcessFacts]]
) -> str | None:
    if (section, name) == ("threads", "torch"):
        return None if all(map(_independent, runs)) else _THREADS_OF_TORCH
    if (section, name) == ("hardware", "platform") and [*map(_library, a)] == [*map(_library, b)]:
        return None  # Two platforms that differ only in the Linux kernel's version count as equal.
    return _ALLOWING.get(section, {}).get(name)


def _independent(processes: Sequence[ProcessFacts]) -> bool:
    """Return whether the processes recorded that results do not depend on the number of torch threads."""
    recorded = (_values(processes, "threads") or {}).get("independent")
    if recorded is not None:
        return all(value is True for value in recorded)
    modes = (_values(processes, "environment_variables") or {}).get("MKL_CBWR", [])
    return bool(modes) and all(str(mode).endswith(",STRICT") and "COMPATIBLE" not in str(mode) for mode in modes)


def _library(platform: object) -> str:
    """Return the operating system and C library from ``platform.platform()``, without the kernel version."""
    system, _, library = str(platform).partition("-with-")
    return f"{system.split('-')[0]} {library}" if library else str(platform)


def source_of(run: RunDirectory, manifest: Manifest) -> list[SourceRecord]:
    """Return the recorded git state of each repository whose code a run used; the main repository is the first."""
    with suppress(RunDirectoryError):
        return load_source(run)
    return [manifest.facts.source or SourceRecord()]


def _code_differences(a: list[SourceRecord], b: list[SourceRecord]) -> Iterator[FactDifference]:
    for number, (one, other) in enumerate(zip_longest(a, b)):
        was, now = ({} if record is None else vars(record) for record in (one, other))
        # Two source trees with equal git tree ids or hashes contain equal files, even if their commits differ.
        if any(was.get(key) is not None and was.get(key) == now.get(key) for key in ("tree", "content_sha256")):
            continue
        mark = f" ({number + 1})" if number else ""
        facts = [name for name in _CODE if was.get(name) != now.get(name)]
        note = describe_changes(one, other, (configs_dir().parent, Path.cwd()))
        for name in facts:
            yield FactDifference("code", name + mark, was.get(name), now.get(name), forbids=True, note=note)
        if not facts:  # Without hashes, equal source records do not prove equal source files.
            yield FactDifference("code", UNKNOWN_CODE + mark, None, None, forbids=True)


def _resume_differences(a: Manifest, b: Manifest) -> Iterator[FactDifference]:
    """Yield resumes that were not exact, with the reasons: other code, or another machine."""
    # Group resumes by the iteration from which they start, because several resumes can start from one checkpoint.
    inexact: tuple[dict[str, list[Resume]], ...] = ({}, {})
    for found, manifest in zip(inexact, (a, b), strict=True):
        for entry in manifest.facts.resumes:
            if entry.exact is False:
                found.setdefault(f"from iteration {entry.iteration}", []).append(entry)
    for name in dict.fromkeys([*inexact[0], *inexact[1]]):
        one, other = (
            "; ".join("; ".join(entry.why) or "not exactly" for entry in side.get(name, ())) or None for side in inexact
        )
        if one != other:
            entries = [entry for side in inexact for entry in side.get(name, ())]
            yield FactDifference("resumed", name, one, other, forbids=not all(map(is_the_machine, entries)))


def is_the_machine(entry: Resume) -> bool:
    """Return whether a resume was inexact only because the computer or the package versions had changed."""
    sections = {difference.get("section") for difference in entry.differences}
    return bool(sections) and sections <= set(SECTIONS) and len(entry.differences) == len(entry.why)


def _installed(run: RunDirectory) -> dict[str, str]:
    try:
        lines = read_bytes(run.environment).decode("utf-8", errors="replace").splitlines()
    except RunDirectoryError:
        return {}
    pairs = (line.split("#")[0].strip().partition("==") for line in lines)
    return {_normal(name): version for name, _, version in pairs if name and version}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def allowing(differences: Iterable[FactDifference]) -> list[FactDifference]:
    """Return those differences between two runs, such as another CPU, that can explain unequal numbers."""
    return [difference for difference in differences if difference.allows]


def forbidding(differences: Iterable[FactDifference]) -> list[FactDifference]:
    """Return those differences between two runs, such as other code, that forbid a comparison within tolerance."""
    return [difference for difference in differences if difference.forbids]
