"""Paths: stock configs and assets in a checkout or an installed package, the cache, user assets, and their display."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.errors import AssetError, WheellegError, nearest_name

CACHE_KEY = "WHEELLEG_CACHE"  # environment variable
# ``NETWORKS`` (actuator networks) and ``GROUND`` (terrain file) are folders next to a robot's MJCF file.
NETWORKS, GROUND = "networks", "ground"
# ``TEACHER`` and ``INITIAL`` are the paths to which a training copies networks of other runs.
TEACHER, INITIAL = f"{NETWORKS}/teacher.pt", f"{NETWORKS}/init_from.pt"

_PACKAGE = Path(__file__).resolve().parent


def _locate(name: str) -> Path:
    for candidate in (_PACKAGE / name, _PACKAGE.parent / name):
        if candidate.is_dir():
            return candidate
    raise AssetError(f"the folder '{name}' of the package wheelleg_exp is missing", expected=f"{_PACKAGE / name}")


def configs_dir() -> Path:
    """Return the folder of the configs that are part of ``wheelleg_exp``."""
    return _locate("configs")


def assets_dir() -> Path:
    """Return the folder of the robot files that are part of ``wheelleg_exp``."""
    return _locate("assets")


def cache_dir() -> Path:
    """Return the cache folder (``WHEELLEG_CACHE``, or the user's cache folder)."""
    root = os.environ.get(CACHE_KEY)
    if root:
        return Path(root)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "wheelleg_exp"
    except RuntimeError:
        raise WheellegError("the user has no home folder", key=CACHE_KEY, expected="a writable folder") from None


def find_asset(name: str, roots: Sequence[Path] = (), *, key: str | None = None, what: str = "robot file") -> Path:
    """Return the file that an asset path in a config names; AssetError lists the searched paths of a missing file.

    A relative path is searched below each of ``roots``, then below the stock assets. Errors name ``key`` and ``what``.
    """
    path = Path(name)
    candidates = [path] if path.is_absolute() else [root / path for root in (*roots, assets_dir())]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    searched = ", ".join(str(c) for c in candidates)
    siblings = [other.name for path in candidates if path.parent.is_dir() for other in path.parent.iterdir()]
    found = nearest_name(Path(name).name, [other for other in siblings if Path(other).suffix == Path(name).suffix])
    nearest = str(Path(name).with_name(found)) if found else None
    raise AssetError(f"there is no file '{name}'", key=key, expected=f"a {what} at one of: {searched}", nearest=nearest)


def show_file(file: Path, line: int | None = None) -> str:
    """Return a file and line as ``file:line``; the path is relative if the file is inside the current folder."""
    try:
        shown = file.relative_to(Path.cwd())
    except ValueError:
        shown = file
    return f"{shown}:{line}" if line is not None else str(shown)
