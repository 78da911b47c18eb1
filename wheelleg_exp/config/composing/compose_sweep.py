"""Compose a sweep: Hydra expands one command line into several jobs, and every job is checked."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from wheelleg_exp.config.checking.find_mistakes import find_mistakes
from wheelleg_exp.config.composing.compose import Composed, is_unread, override_texts, unread_setting
from wheelleg_exp.config.composing.config_loader import Loader, hydra_globals
from wheelleg_exp.config.composing.hydra_errors import parse_override, where_of
from wheelleg_exp.config.config_errors import override_of, raise_all
from wheelleg_exp.errors import ConfigError, not_one_of
from wheelleg_exp.packages import config_folder

QUEUES = ("submitit_local", "submitit_slurm", "ray")
LAUNCHERS = ("basic", "joblib", *QUEUES)
_NEEDS = {
    "submitit_local": ("slurm", ("submitit", "hydra_plugins.hydra_submitit_launcher")),
    "submitit_slurm": ("slurm", ("submitit", "hydra_plugins.hydra_submitit_launcher")),
    "ray": ("ray", ("ray",)),
}


@dataclass
class _Ray:
    init: dict[str, Any] = field(default_factory=lambda: {"address": None})
    remote: dict[str, Any] = field(default_factory=dict)


@dataclass
class _RayLauncher:
    _target_: str = "hydra_plugins.hydra_ray_launcher.ray_launcher.RayLauncher"
    ray: _Ray = field(default_factory=_Ray)


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # ``find_spec`` raises this error if a parent package is missing.
        return False


PRIMARY = "train"
_SWEEPERS = ("basic",)
_MOST_JOBS = 1_000
_OWN = re.compile(r"hydra[./](launcher|sweeper|sweep|mode)\b")
_MULTIRUN = "hydra.mode=MULTIRUN"  # The command-line option -m means the override ``hydra.mode=MULTIRUN``.

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep: all overrides, those that differ between jobs (``swept``), and the SHA-256 of its config."""

    overrides: tuple[str, ...]
    swept: tuple[str, ...]
    config: dict[str, Any] = field(repr=False)
    digest: str


@dataclass(frozen=True)
class Sweep:
    """The jobs of a sweep, in Hydra's order, and the Hydra launcher that starts the jobs.

    ``n_jobs`` is the number of parallel jobs, as joblib counts (-1: one per core, -2: one less), or with a queue such
    as Slurm, the number of all jobs. ``multirun`` is the config that Hydra composes for the sweep as a whole.
    """

    jobs: tuple[SweepJob, ...]
    launcher: str
    n_jobs: int
    multirun: DictConfig = field(repr=False)

    def settings(self, folder: Path) -> dict[str, object]:
        """Return the settings of a sweep's launcher as a plain mapping; ``folder`` is the folder of the sweep."""
        config = self.multirun.copy()
        with open_dict(config):
            config.hydra.sweep.dir = str(folder)
            config.hydra.job.name = "wheelleg"
        found = OmegaConf.to_container(config.hydra.launcher, resolve=True)
        assert isinstance(found, dict)
        return {str(key): value for key, value in found.items()}


def compose_sweep(
    overrides: Sequence[str], *, config_dirs: Sequence[Path] = (), progress: Progress | None = None
) -> Sweep:
    """Expand the overrides into jobs like Hydra's basic sweeper, and compose and check the config of every job.

    One ConfigError lists all mistakes, each once. ``progress`` gets the numbers of checked jobs and of all jobs.
    """
    folders = tuple(config_folder(folder) for folder in config_dirs)
    # Without the package hydra-ray-launcher, Hydra has no config `hydra/launcher/ray`, so register this config.
    if not _is_installed("hydra_plugins.hydra_ray_launcher"):
        ConfigStore.instance().store(group="hydra/launcher", name="ray", node=_RayLauncher, provider="wheelleg_exp")
    with hydra_globals():
        loader = Loader(folders)
        texts = override_texts(overrides)
        parsed: list[Override] = []
        mistakes: list[ConfigError] = []
        for text in texts:
            try:
                parsed.append(parse_override(text, loader))
            except ConfigError as error:
                mistakes.append(error)
        own = [override for override in parsed if _OWN.match(override.key_or_group)]
        chosen = _chosen(own)
        refused = {str(o.input_line): e for o in parsed for e in _refuse(o, chosen)}
        refused |= _refuse_repeated(parsed, loader.groups())
        mistakes += refused.values()
        accepted = [override for override in parsed if str(override.input_line) not in refused]
        multirun: DictConfig | None = None
        # The check of each job reports why Hydra could not compose the settings of the sweep.
        with suppress(ConfigError):
            words = [*(str(override.input_line) for override in accepted), _MULTIRUN]
            multirun = loader.load_configuration(PRIMARY, words, RunMode.MULTIRUN, from_shell=False)
            multirun.hydra.overrides.task = [str(o.input_line) for o in accepted if not o.is_hydra_override()]
        mistakes += _mistakes_of(own, loader.problems)
        params = (multirun.hydra.sweeper.get("params") or {}) if multirun is not None else {}
        texts = [f"{key}={value}" for key, value in params.items()]
        of_files = OverridesParser.create(config_loader=loader).parse_overrides(texts)
        swept = of_files + [o for o in accepted if o not in own]
        _require_few(swept)
        # Each job has a list of overrides, such as ``seed=1`` and ``seed=2`` for ``seed=1,2``.
        fixed = [override for override in swept if not override.is_sweep_override()]
        typed = {f"{o.get_key_element()}={o.get_value_element_as_str()}": str(o.input_line) for o in fixed}
        (split,) = BasicSweeper.split_arguments(swept, None)
        jobs = [[typed.get(text, text) for text in job] for job in split]
        if multirun is not None:
            mistakes += _refuse_chosen(multirun)
    checked = _check(jobs, folders, progress, mistakes)
    # Report a mistake in a swept key once, not once for each job.
    if mistakes:
        raise_all(list({(m.key, m.message): m for m in reversed(mistakes)}.values())[::-1])
    if multirun is None:
        raise_all(loader.problems)
    launcher = str(multirun.hydra.runtime.choices["hydra/launcher"])
    # Submit all sweep jobs to a job queue (such as Slurm) at once, because the queue limits the number of running jobs.
    n_jobs = len(checked) if launcher in QUEUES else 1
    n_jobs = int(multirun.hydra.launcher["n_jobs"]) if launcher == "joblib" else n_jobs
    return Sweep(tuple(checked), launcher, n_jobs, multirun)


def digest_of(composed: Composed) -> str:
    """Return the SHA-256 of a composed config, with unresolved interpolations."""
    return hashlib.sha256(composed.hydra_files()["config.yaml"].encode()).hexdigest()


def _refuse(override: Override, launcher: str) -> Iterator[ConfigError]:
    key, where = override.key_or_group, where_of(override)
    values = {"hydra/launcher": LAUNCHERS, "hydra/sweeper": _SWEEPERS}.get(key)
    extra, modules = _NEEDS.get(str(override.value()), ("", ()))
    if override.is_hydra_override() and override.is_sweep_override():
        yield ConfigError("Hydra's own settings cannot be swept", key=key, where=where, expected="one value")
    elif values is not None and override.value() not in values:
        yield not_one_of(f"'{override.value()}' is not supported", override.value(), values, key=key, where=where)
    elif key == "hydra/launcher" and not all(map(_is_installed, modules)):
        expected = f"pip install 'wheelleg_exp[{extra}]'"
        yield ConfigError(f"'{override.value()}' is not installed", key=key, where=where, expected=expected)
    elif launcher in QUEUES and key.startswith("hydra.launcher."):
        return
    elif is_unread(key) or (values is None and override.is_hydra_override() and override.is_delete()):
        yield unread_setting(key, where)
    elif override.is_sweep_override():
        if not override.is_discrete_sweep():
            expected = "single values, as in choice(0.1,0.5) or range(0,1,0.1)"
            yield ConfigError("an interval has no single values to train", key=key, where=where, expected=expected)
        elif not any(True for _ in override.sweep_iterator()):
            options = override.config_loader.get_group_options(key) if override.config_loader else []
            expected = "a pattern that matches one of " + ", ".join(options) if options else "at least one value"
            yield ConfigError("this override has no value", key=key, where=where, expected=expected)


def _refuse_repeated(parsed: Sequence[Override], groups: Collection[str]) -> dict[str, ConfigError]:
    """Reject keys with several overrides, because Hydra's sweeper would ignore all overrides of a key but the last.

    Several overrides that only replace one value are accepted: the last one counts, as in a single run.
    """
    by_key: dict[str, list[Override]] = {}
    for override in parsed:
        by_key.setdefault(override.get_key_element(), []).append(override)
    message, expected = "this key is given several times", "one override of this key, with all values"
    return {
        str(o.input_line): ConfigError(message, key=o.key_or_group, where=where_of(o), expected=expected)
        for several in by_key.values()
        if len(several) > 1 and not all(_replaces(override, groups) for override in several)
        for o in several
    }


def _replaces(override: Override, groups: Collection[str]) -> bool:
    plain = override.type is OverrideType.CHANGE and not override.is_sweep_override()
    return plain and not isinstance(override.value(), dict) and override.key_or_group not in groups


def _mistakes_of(own: Sequence[Override], problems: Sequence[ConfigError]) -> Iterator[ConfigError]:
    """Yield the mistakes in overrides of Hydra's settings; the check of each job reports the other mistakes."""
    message = "the basic launcher has no settings: it runs one job after the other"
    expected = "hydra/launcher=joblib in addition"
    texts = [str(override.input_line) for override in own]
    for problem in problems:
        if _chosen(own) == "basic" and str(problem.key).startswith("hydra.launcher."):
            yield ConfigError(message, key=problem.key, where=problem.where, expected=expected)
        elif override_of(problem) in texts:
            yield problem


def _chosen(own: Sequence[Override]) -> str:
    return next((str(o.value()) for o in own if o.key_or_group == "hydra/launcher"), "basic")


def _refuse_chosen(multirun: DictConfig) -> Iterator[ConfigError]:
    choices = multirun.hydra.runtime.choices
    for group, known in (("hydra/launcher", LAUNCHERS), ("hydra/sweeper", _SWEEPERS)):
        if choices[group] not in known:
            expected = "one of " + ", ".join(known)
            yield ConfigError(f"'{choices[group]}' is not supported", key=group, expected=expected)
    if multirun.hydra.launcher.get("n_jobs") == 0:
        expected = "1, 2, ... jobs at once, or -1 for one per core"
        yield ConfigError("no job would ever run", key="hydra.launcher.n_jobs", expected=expected)


def _require_few(parsed: Sequence[Override]) -> None:
    """Raise ConfigError if a sweep has more than ``_MOST_JOBS`` jobs: the check of all their configs takes too long."""
    several = [override for override in parsed if override.is_sweep_override()]
    counts = [sum(1 for _ in islice(o.sweep_iterator(), _MOST_JOBS + 1)) for o in several]
    if math.prod(counts) > _MOST_JOBS:
        longest = several[counts.index(max(counts))]
        message, expected = f"the sweep has more than {_MOST_JOBS:,} jobs", "fewer values, or several sweeps"
        raise ConfigError(message, key=longest.key_or_group, where=where_of(longest), expected=expected)


def _check(
    jobs: Sequence[Sequence[str]], folders: Sequence[Path], progress: Progress | None, mistakes: list[ConfigError]
) -> list[SweepJob]:
    checked: list[SweepJob] = []
    found: dict[str, tuple[ConfigError, list[int]]] = {}
    for index, overrides in enumerate(jobs):
        composed, wrong = find_mistakes(overrides, primary=PRIMARY, config_dirs=folders)
        for error in wrong:
            found.setdefault(str(error), (error, []))[1].append(index)
        if composed is not None and not wrong:
            swept = _swept(overrides, jobs)
            checked.append(SweepJob(tuple(overrides), swept, composed.config, digest_of(composed)))
        if progress is not None:
            progress(index + 1, len(jobs))
    for error, indices in found.values():
        swept = _swept(jobs[indices[0]], jobs)
        # A mistake in only some jobs names the overrides of its job, unless one of them is the cause.
        if len(indices) < len(jobs) and override_of(error) not in swept:
            others = "" if len(indices) == 1 else f" and {len(indices) - 1} more"
            message = f"{error.message} [with {' '.join(swept)}{others}]"
            facts = {"key": error.key, "where": error.where, "expected": error.expected, "nearest": error.nearest}
            error = ConfigError(message, **facts)
        mistakes.append(error)
    return checked


def _swept(overrides: Sequence[str], jobs: Sequence[Sequence[str]]) -> tuple[str, ...]:
    return tuple(text for i, text in enumerate(overrides) if any(job[i] != text for job in jobs))
