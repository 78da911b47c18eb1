"""Typed records of a run: what ``manifest.json`` says about a process, its resumes, and its files.

The first wrong value is an error. Keys of newer versions are ignored, and stay in the file that ``Manifest`` writes.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from typing import Any, TypedDict, TypeVar, get_args, get_origin, get_type_hints, is_typeddict

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.file_inventory import FileRecord
from wheelleg_exp.run.run_lock import ProcessId
from wheelleg_exp.run.source_changes import SourceRecord

T = TypeVar("T")


class _WrongValue(ValueError):
    """A value has a wrong type, or is missing; the text is the dotted path of its key."""


def read_record(kind: type[T], value: object, broken: str, where: object) -> T:
    """Return parsed JSON as a ``kind``: a dataclass, or a TypedDict, which is the unchanged mapping.

    A missing or null key becomes the field's default. RunDirectoryError starts with ``broken``, and names key and file.
    """
    try:
        found: T = _read(value, kind, "")
    except _WrongValue as error:
        message = f"{broken}: the key '{error}' is missing or has a wrong value"
        raise RunDirectoryError(message, where=str(where)) from None
    return found


def _read(value: object, kind: Any, path: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is object:
        return value
    if origin is types.UnionType:
        (only,) = (argument for argument in arguments if argument is not types.NoneType)
        return None if value is None else _read(value, only, path)
    if is_dataclass(kind) or is_typeddict(kind):
        if not isinstance(value, dict):
            raise _WrongValue(path)
        found, (hints, required) = {}, _keys(kind)
        for key, hint in hints.items():
            if key not in value and key in required:
                raise _WrongValue(_join(path, key))
            if value.get(key) is not None or key in required:
                found[key] = _read(value.get(key), hint, _join(path, key))
        return value if is_typeddict(kind) else kind(**found)
    if origin is Mapping and isinstance(value, dict):
        return {key: _read(item, arguments[1], _join(path, key)) for key, item in value.items()}
    if origin in (list, tuple) and isinstance(value, list):
        kinds = arguments if origin is tuple and arguments[-1] is not ... else arguments[:1] * len(value)
        if len(kinds) == len(value):
            items = enumerate(zip(value, kinds, strict=True))
            return origin(_read(item, inner, f"{path}[{index}]") for index, (item, inner) in items)
    is_kind = origin is None and isinstance(value, (int, float) if kind is float else kind)
    if is_kind and (kind is bool or not isinstance(value, bool)):
        return value
    raise _WrongValue(path)


@cache
def _keys(kind: type) -> tuple[dict[str, object], frozenset[str]]:
    """Return the types of a record's keys, and the names of the required keys."""
    hints = get_type_hints(kind)
    if is_typeddict(kind):
        return hints, frozenset(vars(kind)["__required_keys__"])
    optional = {each.name for each in fields(kind) if (each.default, each.default_factory) != (MISSING, MISSING)}
    return hints, frozenset(hints) - optional


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else str(key)


@dataclass(frozen=True)
class RunError:
    """The exception that ended a run."""

    type: str | None = None
    message: str | None = None


class Failure(TypedDict):
    """The config key and the training iteration in which a number was not finite."""

    key: str | None
    iteration: int
    message: str


@dataclass(frozen=True, kw_only=True)
class ProcessFacts:
    """The facts about the last process of a run that can change numbers; None for facts that were not recorded."""

    versions: Mapping[str, object] | None = None
    modules: Mapping[str, str] | None = None
    hardware: Mapping[str, object] | None = None
    threads: Mapping[str, object] | None = None
    environment_variables: Mapping[str, str] | None = None
    resumes: tuple[Resume, ...] = ()

    @property
    def processes(self) -> list[ProcessFacts]:
        return [*(entry.before for entry in self.resumes if entry.before is not None), self]


@dataclass(frozen=True, kw_only=True)
class ProcessRecord(ProcessFacts):
    """The state of a run before a resume."""

    status: str | None = None
    error: RunError | None = None
    ended: str | None = None
    process: ProcessId | None = None
    failure: Failure | None = None
    files: Mapping[str, FileRecord] = field(default_factory=dict)


class Difference(TypedDict, total=False):
    """A fact that a resume found different: its section, such as ``hardware``, and its name."""

    section: str
    name: str


class Setting(TypedDict, total=False):
    """A setting that a resume changed, with its new value ``now``."""

    key: str
    now: object


@dataclass(frozen=True)
class Resume:
    """One resume of a run: its overrides, whether it was exact, and why it was not."""

    when: str | None = None
    iteration: int | None = None
    command: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    exact: bool | None = None
    why: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    changes: tuple[Setting, ...] = ()
    differences: tuple[Difference, ...] = ()
    proved: tuple[object, ...] = ()
    before: ProcessRecord | None = None
    files_to_write: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Addition:
    """The files and results that a later command, such as ``wheelleg play``, added to a run."""

    when: str
    files: Mapping[str, FileRecord]
    kind: str | None = None
    results: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class InitFrom:
    """The run and the iteration whose networks a training started with; ``named`` is the value of ``init_from``."""

    named: str
    run: str | None = None
    iteration: int | None = None


@dataclass(frozen=True)
class Ranks:
    """The processes that trained a run together."""

    world_size: int
    backend: str | None = None
    seeds: tuple[object, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RunRecord(ProcessRecord):
    """The content of a run's ``manifest.json``."""

    # Without ``field()``, these keys would be optional, with the defaults of the base class.
    status: str = field()
    task: str
    started: str
    results: Mapping[str, object]
    resumes: tuple[Resume, ...] = field()
    additions: tuple[Addition, ...]
    files: Mapping[str, FileRecord] = field()
    id: str | None = None
    working_directory: str | None = None
    recording_unfinished: str | None = None
    replay_of: str | None = None
    stock: str | None = None
    command: tuple[str, ...] = ()
    config_dirs: tuple[str, ...] | None = None
    config_variables: Mapping[str, str] | None = None
    seeds: tuple[int, ...] = ()
    source: SourceRecord | None = None
    init_from: InitFrom | None = None
    last_ended_by: Mapping[str, int] = field(default_factory=dict)
    ranks: Ranks | None = None

    @property
    def has_source(self) -> bool:
        return self.source is not None and self.source.status != ""
