"""Compose a sweep: Hydra expands one command line into several jobs, and every job is checked.

The module also lists the launchers that a sweep accepts, with the packages that each launcher needs and the number of
jobs that it runs at once.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from wheelleg_exp.config.checking.find_mistakes import find_mistakes
from wheelleg_exp.config.composing.compose import Composed, compose, is_unread, override_texts, unread_setting
from wheelleg_exp.config.composing.config_loader import COMPOSING_ERRORS, Loader, hydra_globals, require_folder
from wheelleg_exp.config.composing.hydra_errors import translate, where_of
from wheelleg_exp.config.config_errors import override_of, parts, raise_all
from wheelleg_exp.errors import ConfigError, nearest_name

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


def offer_ray() -> None:
    """Register the settings of hydra-ray-launcher for ``hydra/launcher=ray``, if that package is not installed.

    Only its settings are needed. The package itself conflicts with the version of cloudpickle that others require.
    """
    if not _is_there("hydra_plugins.hydra_ray_launcher"):
        ConfigStore.instance().store(group="hydra/launcher", name="ray", node=_RayLauncher, provider="wheelleg_exp")


def not_installed(launcher: str) -> str | None:
    """Return the command that installs a launcher's packages; None if they are installed."""
    extra, modules = _NEEDS.get(launcher, ("", ()))
    return None if all(map(_is_there, modules)) else f"pip install 'wheelleg_exp[{extra}]'"


def jobs_at_once(launcher: str, settings: Mapping[str, Any], jobs: int) -> int:
    """Return how many jobs are submitted at once, as joblib counts.

    Args:
        launcher: one of ``LAUNCHERS``.
        settings: the section ``hydra.launcher``.
        jobs: the number of jobs.
    """
    if launcher == "joblib":
        return int(settings["n_jobs"])
    return jobs if launcher in QUEUES else 1  # the queue itself limits how many jobs run


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a parent package is missing
        return False


PRIMARY = "train"
_SWEEPERS = ("basic",)
_OWN = re.compile(r"hydra[./](launcher|sweeper|sweep|mode)\b")
_MULTIRUN = "hydra.mode=MULTIRUN"  # the override that Hydra's -m adds

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep.

    Attributes:
        overrides: the overrides with which ``wheelleg train`` trains this job alone.
        swept: the overrides that differ between jobs.
        config: the resolved config.
        digest: digest of the composed config.
    """

    overrides: tuple[str, ...]
    swept: tuple[str, ...]
    config: dict[str, Any] = field(repr=False)
    digest: str


@dataclass(frozen=True)
class Sweep:
    """The jobs of a sweep, in Hydra's order, and their launcher.

    Attributes:
        jobs: the jobs, at least one.
        launcher: one of ``LAUNCHERS``.
        n_jobs: how many jobs run at once, as joblib counts: -1 for one per core, -2 for one per core but one. For a
            queue: how many jobs are submitted at once.
        multirun: the config that Hydra composes for a multirun, including Hydra's own node.
    """

    jobs: tuple[SweepJob, ...]
    launcher: str
    n_jobs: int
    multirun: DictConfig = field(repr=False)

    def settings(self, folder: Path) -> dict[str, Any]:
        """Return the launcher's settings as a plain mapping, for the folder of the sweep."""
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
    """Expand the overrides like Hydra's basic sweeper, and compose and check every job.

    Args:
        overrides: Hydra overrides; ``a=1,2``, ``choice()``, ``range()`` and ``glob()`` expand to several jobs.
        config_dirs: the user's config folders.
        progress: called with the number of checked jobs and the number of all jobs.

    Raises:
        ConfigError: the mistakes in all jobs, each of them once.
    """
    folders = tuple(require_folder(folder) for folder in config_dirs)
    offer_ray()
    with hydra_globals():
        loader = Loader(folders)
        parsed, mistakes = _parse(override_texts(overrides), loader)
        own = [override for override in parsed if _OWN.match(override.key_or_group)]
        chosen = _chosen(own)
        refused = {str(o.input_line): e for o in parsed for e in _refuse(o, chosen)}
        refused |= _refuse_repeated(parsed, loader.groups())
        mistakes += refused.values()
        accepted = [override for override in parsed if str(override.input_line) not in refused]
        multirun = _compose_multirun(loader, accepted)
        if multirun is None:
            mistakes += _mistakes_of([o for o in accepted if o in own], folders)
        jobs = _expand(_params(multirun, loader) + [o for o in accepted if o not in own])
        mistakes += [] if multirun is None else _refuse_chosen(multirun)
    checked = _check(jobs, folders, progress, mistakes)
    if mistakes:  # a wrong key is reported once, not for each of its values
        raise_all(list({(m.key, m.message): m for m in reversed(mistakes)}.values())[::-1])
    if multirun is None:
        multirun = _compose_launcher(loader, own, parsed)
    launcher = str(multirun.hydra.runtime.choices["hydra/launcher"])
    return Sweep(tuple(checked), launcher, jobs_at_once(launcher, multirun.hydra.launcher, len(checked)), multirun)


def digest_of(composed: Composed) -> str:
    """Return the digest of a composed config, with interpolations as written."""
    return hashlib.sha256(composed.hydra_files()["config.yaml"].encode()).hexdigest()


def _parse(texts: Sequence[str], loader: Loader) -> tuple[list[Override], list[ConfigError]]:
    parser = OverridesParser.create(config_loader=loader)
    parsed: list[Override] = []
    mistakes: list[ConfigError] = []
    for text in texts:
        try:
            parsed += parser.parse_overrides([text])
        except HydraException as error:
            mistakes += parts(translate(error, loader, PRIMARY, [text]))
    return parsed, mistakes


def _refuse(override: Override, launcher: str) -> Iterator[ConfigError]:
    """Yield the mistakes in an override that are visible before anything is composed."""
    key, where = override.key_or_group, where_of(override)
    values = {"hydra/launcher": LAUNCHERS, "hydra/sweeper": _SWEEPERS}.get(key)
    if override.is_hydra_override() and override.is_sweep_override():
        yield ConfigError("Hydra's own settings cannot be swept", key=key, where=where, expected="one value")
    elif values is not None and override.value() not in values:
        chosen = str(override.value())
        yield ConfigError(
            f"'{chosen}' is not supported",
            key=key,
            where=where,
            expected="one of " + ", ".join(values),
            nearest=nearest_name(chosen, values),
        )
    elif key == "hydra/launcher" and (absent := not_installed(str(override.value()))) is not None:
        yield ConfigError(f"'{override.value()}' is not installed", key=key, where=where, expected=absent)
    elif launcher in QUEUES and key.startswith("hydra.launcher."):
        return
    elif is_unread(key) or (values is None and override.is_hydra_override() and override.is_delete()):
        yield unread_setting(key, where)
    elif override.is_sweep_override():
        yield from _refuse_values(override)


def _refuse_values(override: Override) -> Iterator[ConfigError]:
    key, where = override.key_or_group, where_of(override)
    if not override.is_discrete_sweep():
        expected = "single values, as in choice(0.1,0.5) or range(0,1,0.1)"
        yield ConfigError("an interval has no single values to train", key=key, where=where, expected=expected)
    elif not any(True for _ in override.sweep_iterator()):
        options = override.config_loader.get_group_options(key) if override.config_loader else []
        expected = "a pattern that matches one of " + ", ".join(options) if options else "at least one value"
        yield ConfigError("this override has no value", key=key, where=where, expected=expected)


def _refuse_repeated(parsed: Sequence[Override], groups: Collection[str]) -> dict[str, ConfigError]:
    """Reject repeated keys. Hydra's sweeper silently uses the last one only.

    A repeated key is accepted if every override of it only replaces one value.
    """
    by_key: dict[str, list[Override]] = {}
    for override in parsed:
        by_key.setdefault(override.get_key_element(), []).append(override)
    return {
        str(override.input_line): ConfigError(
            "this key is given several times",
            key=override.key_or_group,
            where=where_of(override),
            expected="one override of this key, with all values",
        )
        for several in by_key.values()
        if len(several) > 1 and not all(_replaces(override, groups) for override in several)
        for override in several
    }


def _replaces(override: Override, groups: Collection[str]) -> bool:
    """Return whether an override only replaces one value. Of several, the last one counts, as without a sweep."""
    plain = override.type is OverrideType.CHANGE and not override.is_sweep_override()
    return plain and not isinstance(override.value(), dict) and override.key_or_group not in groups


def _compose_multirun(loader: Loader, parsed: Sequence[Override]) -> DictConfig | None:
    """Return the config that Hydra composes for the whole multirun; None if it cannot be composed."""
    texts = [*(str(override.input_line) for override in parsed), _MULTIRUN]
    try:
        return loader.load_configuration(PRIMARY, texts, RunMode.MULTIRUN, from_shell=False)
    except (*COMPOSING_ERRORS, ConfigError):
        return None  # the mistakes of the jobs explain the reason


def _compose_launcher(loader: Loader, own: Sequence[Override], parsed: Sequence[Override]) -> DictConfig:
    """Compose the multirun without the jobs' own overrides, which can name a key that only the swept tasks have."""
    texts = [*(str(override.input_line) for override in own), _MULTIRUN]
    with hydra_globals():
        multirun = loader.load_configuration(PRIMARY, texts, RunMode.MULTIRUN, from_shell=False)
    multirun.hydra.overrides.task = [str(o.input_line) for o in parsed if not o.is_hydra_override()]
    return multirun


def _mistakes_of(own: Sequence[Override], folders: Sequence[Path]) -> list[ConfigError]:
    """Return the mistakes in the settings of the launcher."""
    chosen = _chosen(own)
    used = [o for o in own if chosen != "basic" or not o.key_or_group.startswith("hydra.launcher.")]
    errors = [_of_joblib(override) for override in own if override not in used]
    try:
        texts = [str(override.input_line) for override in used]
        compose(texts, primary=PRIMARY, config_dirs=folders, launching=True)
    except ConfigError as error:
        errors += parts(error)
    return errors


def _chosen(own: Sequence[Override]) -> str:
    return next((str(o.value()) for o in own if o.key_or_group == "hydra/launcher"), "basic")


def _of_joblib(override: Override) -> ConfigError:
    return ConfigError(
        "the basic launcher has no settings: it runs one job after the other",
        key=override.key_or_group,
        where=where_of(override),
        expected="hydra/launcher=joblib in addition",
    )


def _refuse_chosen(multirun: DictConfig) -> list[ConfigError]:
    """Return the mistakes in the launcher and the sweeper that files and overrides together have selected."""
    errors = []
    choices = multirun.hydra.runtime.choices
    for group, known in (("hydra/launcher", LAUNCHERS), ("hydra/sweeper", _SWEEPERS)):
        if choices[group] not in known:
            expected = "one of " + ", ".join(known)
            errors.append(ConfigError(f"'{choices[group]}' is not supported", key=group, expected=expected))
    if multirun.hydra.launcher.get("n_jobs") == 0:
        expected = "1, 2, ... jobs at once, or -1 for one per core"
        errors.append(ConfigError("no job would ever run", key="hydra.launcher.n_jobs", expected=expected))
    return errors


def _params(multirun: DictConfig | None, loader: Loader) -> list[Override]:
    """Return the overrides in ``hydra.sweeper.params`` of the config files."""
    params = multirun.hydra.sweeper.get("params") if multirun is not None else None
    texts = [f"{key}={value}" for key, value in (params or {}).items()]
    return OverridesParser.create(config_loader=loader).parse_overrides(texts)


def _expand(parsed: Sequence[Override]) -> list[list[str]]:
    """Return the overrides of every job. An override that is not swept stays as typed."""
    fixed = [override for override in parsed if not override.is_sweep_override()]
    typed = {f"{o.get_key_element()}={o.get_value_element_as_str()}": str(o.input_line) for o in fixed}
    (jobs,) = BasicSweeper.split_arguments(list(parsed), None)
    return [[typed.get(text, text) for text in job] for job in jobs]


def _check(
    jobs: Sequence[Sequence[str]], folders: Sequence[Path], progress: Progress | None, mistakes: list[ConfigError]
) -> list[SweepJob]:
    """Compose and check every job, and append the mistakes, each once, to ``mistakes``."""
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
        mistakes.append(_in_job(error, indices, jobs))
    return checked


def _swept(overrides: Sequence[str], jobs: Sequence[Sequence[str]]) -> tuple[str, ...]:
    return tuple(text for i, text in enumerate(overrides) if any(job[i] != text for job in jobs))


def _in_job(error: ConfigError, indices: Sequence[int], jobs: Sequence[Sequence[str]]) -> ConfigError:
    """Add the job's overrides to the message, unless every job has the mistake or its place is one of them."""
    swept = _swept(jobs[indices[0]], jobs)
    if len(indices) == len(jobs) or override_of(error) in swept:
        return error
    others = "" if len(indices) == 1 else f" and {len(indices) - 1} more"
    message = f"{error.message} [with {' '.join(swept)}{others}]"
    return ConfigError(message, key=error.key, where=error.where, expected=error.expected, nearest=error.nearest)
