"""Where the stock configs and assets are, in a checkout and in an installed package alike; how a place is shown."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.errors import AssetError, WheellegError, nearest_name

# Beside a robot's MJCF, by their names in the config: the networks of its actuators, and the ground's own file.
CACHE_KEY = "WHEELLEG_CACHE"  # the variable that names the cache
NETWORKS, GROUND = "networks", "ground"
# Of other runs: the policy that teaches, and the networks that a training begins with.
TEACHER, INITIAL = f"{NETWORKS}/teacher.pt", f"{NETWORKS}/init_from.pt"

_PACKAGE = Path(__file__).resolve().parent


def _locate(name: str) -> Path:
    for candidate in (_PACKAGE / name, _PACKAGE.parent / name):
        if candidate.is_dir():
            return candidate
    raise AssetError(f"the package's '{name}' folder is missing", expected=f"{_PACKAGE / name}")


def configs_dir() -> Path:
    """Return the folder of the stock configs."""
    return _locate("configs")


def assets_dir() -> Path:
    """Return the folder of the stock assets."""
    return _locate("assets")


def cache_dir() -> Path:
    """Return the folder for files that can be made again (``WHEELLEG_CACHE``, or the user's cache folder).

    Raises:
        WheellegError: no variable names a folder, and the user has no home folder.
    """
    root = os.environ.get(CACHE_KEY)
    if root:
        return Path(root)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "wheelleg_exp"
    except RuntimeError:
        raise WheellegError("the user has no home folder", key=CACHE_KEY, expected="a writable folder") from None


def find_asset(name: str, roots: Sequence[Path] = (), *, key: str | None = None, what: str = "robot file") -> Path:
    """Return the file that a config's relative asset path names.

    Args:
        name: path as written in the config; a relative one is looked up below each root, then below the
            stock assets.
        roots: folders of the user's own assets, searched first.
        key: config key that holds the path, for the message.
        what: what kind of file it is, for the message.

    Raises:
        AssetError: no such file, with the places that were searched.
    """
    path = Path(name)
    candidates = [path] if path.is_absolute() else [root / path for root in (*roots, assets_dir())]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    searched = ", ".join(str(c) for c in candidates)
    raise AssetError(
        f"there is no file '{name}'",
        key=key,
        expected=f"a {what} at one of: {searched}",
        nearest=_nearest_file(name, candidates),
    )


def _nearest_file(name: str, candidates: Sequence[Path]) -> str | None:
    """Return the name of a file that is there, beside a candidate, in the place of the last part of ``name``."""
    beside = [other.name for path in candidates if path.parent.is_dir() for other in path.parent.iterdir()]
    found = nearest_name(Path(name).name, [other for other in beside if Path(other).suffix == Path(name).suffix])
    return str(Path(name).with_name(found)) if found else None


def show_file(file: Path, line: int | None = None) -> str:
    """Return ``file:line``, relative to the current folder when the file lies in it."""
    try:
        shown = file.relative_to(Path.cwd())
    except ValueError:
        shown = file
    return f"{shown}:{line}" if line is not None else str(shown)
