"""Which packages a config's ``_target_`` may come from: a config runs no other code."""

from __future__ import annotations

import functools

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.packages import installed_packages, joined_packages

TARGET = "_target_"
# A config may build terms, noise, entities, actuators and sensors, but call nothing else of this package.
_OWN_PACKAGES = ("wheelleg_exp.mdp", "wheelleg_exp.managers", "wheelleg_exp.sim")


class NotAllowed(ConfigError):
    """A target or a class lies outside the allowed packages."""


def allowed_packages() -> tuple[str, ...]:
    """Return the packages that targets may come from: this one's terms, and those that declare themselves.

    A user's package joins by an entry point in the group ``wheelleg_exp.packages``, whose value is its name: installed,
    or in the ``pyproject.toml`` of the project whose configs are in use (see ``wheelleg_exp.packages``).
    """
    return tuple(dict.fromkeys((*_OWN_PACKAGES, *_declared_packages(), *joined_packages())))


@functools.cache
def _declared_packages() -> tuple[str, ...]:
    """Read the declarations of every installed distribution, once: it takes a millisecond."""
    return installed_packages()


def require_allowed(target: str, path: str) -> None:
    """Raise ConfigError unless ``target`` lies in an allowed package, so that a config runs no other code."""
    packages = allowed_packages()
    if not is_inside(target, packages):
        raise NotAllowed(
            f"target '{target}' is outside the allowed packages",
            key=f"{path}.{TARGET}",
            expected="a target in " + ", ".join(packages),
            nearest=_in_nearest_package(target, packages),
        )


def _in_nearest_package(target: str, packages: tuple[str, ...]) -> str | None:
    """Return a target with the name of its package put right."""
    top, _, rest = target.partition(".")
    near = nearest_name(top, [package.split(".")[0] for package in packages])
    return f"{near}.{rest}" if near not in (None, top) else None


def is_inside(name: str, packages: tuple[str, ...]) -> bool:
    """Return whether a dotted name lies in one of the packages."""
    return any(name.startswith(f"{package}.") for package in packages)
