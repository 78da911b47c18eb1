"""Which folders hold the source of a training: this package, the user's projects and configs, and what was imported."""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.packages import installed_packages, joined_packages, project_of, read_project
from wheelleg_exp.paths import configs_dir

_OWN = "wheelleg_exp"
_INSTALL_FOLDERS = ("site-packages", "dist-packages")
_CALLS = ("_target_", "class_name")


def source_roots(composed: Composed) -> list[Path]:
    """Return the folders whose source a config's training depends on, this package's own first.

    Beside it: each project of the user's as a whole (packages and assets, not its configs alone), every other folder of
    Hydra's search path, and the packages that the config calls. The folder of the robot's file is none of them: a run
    keeps the robot itself, and the digests of the files that it was made of.
    """
    roots = [configs_dir().parent, *(_project_or_folder(folder) for folder in _config_folders(composed))]
    roots += [root for name in _packages_called(composed.config) if (root := _package_root(name)) is not None]
    return _once(roots)


def installed_roots() -> list[Path]:
    """Return the folders of the installed packages that declare themselves, without importing them."""
    return [root for name in installed_packages() if (root := _package_root(name)) is not None]


def loaded_outside(roots: Sequence[Path]) -> list[Path]:
    """Return the packages and modules imported from anywhere but the roots, the standard library and environments.

    They came by ``PYTHONPATH``, the working folder or a path file, and have had their part in what was built.
    """
    known = [root.resolve() for root in roots] + _python_folders()
    found = []
    for name in sorted({name.partition(".")[0] for name in list(sys.modules)}):
        module = sys.modules.get(name)
        for place in _places(module):
            if not _in_environment(place) and not any(_below(place, folder) for folder in known):
                found.append(place)
    return _once(found)


def _config_folders(composed: Composed) -> Iterator[Path]:
    yield from composed.config_dirs
    for source in composed.loader.repository_used.get_sources():
        path = Path(source.path)
        if source.scheme() == "file" and path.resolve() != configs_dir().resolve():
            yield path
        elif source.scheme() == "pkg" and (root := _package_root(source.path)) is not None:
            yield root


def _project_or_folder(folder: Path) -> Path:
    project = read_project(folder.parent)
    return folder.parent if project is not None else folder


def _packages_called(config: Mapping[str, Any]) -> list[str]:
    """Return the packages of users' own that the config's targets and classes lie in, by name."""
    declared = {*installed_packages(), *joined_packages()}
    called = set(_called(config))
    return sorted(name for name in declared if any(call.startswith(f"{name}.") for call in called))


def _called(node: Any) -> Iterator[str]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            if key in _CALLS and isinstance(value, str):
                yield value.replace(":", ".")
            yield from _called(value)
    elif isinstance(node, list):
        for value in node:
            yield from _called(value)


def _package_root(name: str) -> Path | None:
    """Return the folder or file of a package's top, without importing it; that of its project when it has one."""
    top = name.replace("/", ".").partition(".")[0]
    if top in (_OWN, "hydra"):
        return None
    project = project_of(name)
    if project is not None:
        return project.root
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    places = [Path(place) for place in spec.submodule_search_locations or ()]
    return places[0] if places else (Path(spec.origin) if spec.has_location and spec.origin else None)


def _places(module: Any) -> list[Path]:
    """Return where a top-level module stands: its folders, or its file."""
    folders = [Path(place) for place in getattr(module, "__path__", ()) if isinstance(place, str)]
    file = getattr(module, "__file__", None)
    found = folders or ([Path(file)] if isinstance(file, str) else [])
    # A system's sitecustomize is a link in the standard library to somewhere else.
    own = [path for path in found if path.is_absolute() and not any(path.is_relative_to(f) for f in _python_folders())]
    return [path.resolve() for path in own if path.exists()]


def _python_folders() -> list[Path]:
    paths = sysconfig.get_paths()
    return [Path(paths[key]).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib", "scripts")]


def _in_environment(path: Path) -> bool:
    return any(part in _INSTALL_FOLDERS for part in path.parts)


def _below(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _once(paths: Iterable[Path]) -> list[Path]:
    return list({path.resolve(): path for path in reversed(list(paths))}.values())[::-1]
