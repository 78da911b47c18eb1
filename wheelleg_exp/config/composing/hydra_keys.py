"""Hydra's own settings: which of them do something here, and what to write in place of the others."""

from __future__ import annotations

import re
from collections.abc import Sequence

from wheelleg_exp.errors import ConfigError, UnreadKey

_KEY = re.compile(r"[+~]*(hydra(?:[./][^=@]*)?)(?=[=@]|$)")
_READ = re.compile(r"hydra(/launcher|/sweeper|\.(searchpath|launcher\.n_jobs|sweeper\.params)(\..+)?)$")
_OF_SWEEPS = ("launcher", "sweeper")
_INSTEAD = {
    "run": "run.root=DIR, below which run directories are made, and run.name=NAME",
    "job": "run.name=NAME for the run directory's name",
    "output_subdir": "run.root=DIR; Hydra's files stand in .hydra of the run directory",
    "sweep": "run.root; every job is a run directory of its own below it",
    "mode": "-m (--multirun) alone",
    "launcher": "hydra.launcher.n_jobs, how many jobs run at once",
    "sweeper": "hydra.sweeper.params, overrides by key",
    "verbose": "--debug, which shows the traceback of an error",
}
_OTHER = "a key of the config; of Hydra's own settings hydra.searchpath is read, and those of a launcher with -m"


def is_unread(key: str) -> bool:
    """Return whether a key or a group, as typed in an override or not, is Hydra's own and nothing reads it."""
    found = _KEY.match(key)
    return found is not None and not _READ.match(found[1])


def unread(key: str, where: str, expected: str | None = None) -> ConfigError:
    """Return the error of a setting of Hydra's that nothing reads; what to write is known by its name."""
    instead = expected or _INSTEAD.get(_name(key), _OTHER)
    return UnreadKey("nothing reads this", key=key, where=where, expected=instead)


def unread_overrides(overrides: Sequence[str]) -> list[ConfigError]:
    """Return the errors of overrides, as typed, that set what nothing reads where one run is composed."""
    errors = []
    for text in overrides:
        found = _KEY.match(text)
        key, where = found[1] if found else "", f"override {text}"
        if _name(key) in _OF_SWEEPS:
            expected = "-m (--multirun) beside it, or neither"
            message = "this is a setting of a sweep, and this is one run"
            errors.append(ConfigError(message, key=key, where=where, expected=expected))
        elif is_unread(text):
            errors.append(unread(key, where))
    return errors


def _name(key: str) -> str:
    """Return which of Hydra's settings a key or a group is about, such as ``run``."""
    return re.split(r"[./]", key, maxsplit=2)[1] if re.match(r"hydra[./]", key) else ""
