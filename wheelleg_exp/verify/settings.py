"""What two runs were asked to compute: seeds, task, parameters, the robot; compared by leaf."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from wheelleg_exp.config.changes import ABSENT, Change, changes, same
from wheelleg_exp.config.tree import Keys
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, sha256
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.params import load_params
from wheelleg_exp.run.recorded import ROBOT, written_config

# They change when and what is written, how fast, or what there is room for: too little is an error.
_HARMLESS = (
    ("agent", "max_iterations"),
    ("agent", "save_interval"),
    ("agent", "max_non_finite"),
    ("agent", "torch_threads"),
    ("agent", "logger"),
    ("env", "sim", "nthread"),
    ("env", "sim", "nconmax"),
    ("env", "sim", "njmax"),
    ("env", "sim", "graph"),
    ("env", "sim", "deterministic"),
    ("recording",),
)


def decides(keys: Keys) -> bool:
    """Return whether the setting at these keys can change a number; what lies below harmless keys cannot either."""
    return not any(keys[: len(harmless)] == harmless for harmless in _HARMLESS)


def setting_changes(a: RunDirectory, b: RunDirectory) -> list[Change]:
    """Return how the settings of two runs differ, those that decide numbers first.

    Raises:
        RunDirectoryError: the parameters of a run are missing or damaged.
    """
    found = plain_changes(_settings(a), _settings(b))
    return sorted(found, key=lambda change: not decides(change.keys))


def robot_changes(a: RunDirectory, b: RunDirectory) -> list[Change]:
    """Return how the robots differ: the file's digests, the generated MJCF, the compiled model."""
    return plain_changes(_robot(a), _robot(b))


def plain_changes(a: Any, b: Any, keys: Keys = ()) -> list[Change]:
    """Return how two plain values differ: leaves, to the bit, and the order of terms, in which they run."""
    return [*changes(a, b, _same, keys), *_reordered(keys, a, b)]


def as_dict(change: Change) -> dict[str, Any]:
    """Return a change for JSON."""
    a, b = (str(value) if value is ABSENT else value for value in (change.a, change.b))
    return {"key": change.key, "a": a, "b": b, "decides": decides(change.keys)}


def recording_changes(changes: list[Change]) -> list[Change]:
    """Return the changes that decide what a recording holds."""
    return [change for change in changes if change.keys[0].startswith("recording")]


def _settings(run: RunDirectory) -> dict[str, Any]:
    env, agent = load_params(run)
    data = run.manifest().data
    resumes = [entry for entry in data["resumes"] if isinstance(entry, Mapping)]
    changed = [[entry.get("iteration"), changes] for entry in resumes if (changes := _resume_changes(entry))]
    settings = {
        "seed": data.get("seeds"),
        "task": data["task"],
        "env": env,
        "agent": agent,
        "resumed with other settings": changed,
    }
    config = written_config(run)
    return {**settings, "recording": config["recording"]} if "recording" in config else settings


def _resume_changes(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a resume changed of the settings that decide numbers."""
    changes = [change for change in entry.get("changes") or () if isinstance(change, Mapping)]
    return {str(c.get("key")): c.get("now") for c in changes if decides(tuple(str(c.get("key")).split(".")))}


def _robot(run: RunDirectory) -> dict[str, Any]:
    mjcf, identity = run.asset / "robot.xml", run.path / ROBOT
    try:
        known = read_json(identity) if identity.is_file() else {}
        digest = sha256(mjcf) if mjcf.is_file() else None
    except RunDirectoryError as error:
        return {"damaged": str(error)}
    known = known if isinstance(known, Mapping) else {}
    return {"sources": known.get("sources"), "robot.xml": digest, "compiled model": known.get("model_sha256")}


def _reordered(keys: Keys, a: Any, b: Any) -> Iterator[Change]:
    if not (isinstance(a, Mapping) and isinstance(b, Mapping)):
        return
    ones, others = ([name for name in x if name in y and isinstance(x[name], Mapping)] for x, y in ((a, b), (b, a)))
    if ones != others and sorted(map(str, ones)) == sorted(map(str, others)):
        yield Change((*keys[:-1], f"{keys[-1] if keys else ''} (order)"), ones, others)
    for name in ones:
        yield from _reordered((*keys, str(name)), a[name], b[name])


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b) or (a != a and b != b)
    return same(a, b)
