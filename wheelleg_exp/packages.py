"""Find user projects, whose ``pyproject.toml`` declares packages for configs, and folders that the user trusts.

A project declares its packages in the entry-point group ``wheelleg_exp.packages``. It is found through the metadata of
its distribution, the current folder, or the option ``--config-dir``. Hydra reads config files from its folder
``configs/``. A declared package is imported if a config names a function or class of it in ``_target_``; other packages
cannot be imported from the project.

A path that is recorded in a run is not trusted, because the run can come from somebody else. It is used only if it
leads to the current project, or to a folder that the user has named with ``--config-dir``. Only ``cli/main.py`` adds
trusted folders, because only ``cli/main.py`` knows the user's command line.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.paths import cache_dir


def trust(folders: Iterable[Path]) -> None:
    """Add existing ``folders``, which the user named on the command line, to the saved list of trusted folders."""
    known = _trusted()
    existing = map(os.path.realpath, filter(Path.is_dir, folders))
    new = [place for place in dict.fromkeys(existing) if place not in known]
    with suppress(OSError):
        if new:
            _trust_file().parent.mkdir(parents=True, exist_ok=True)
            with _trust_file().open("a", encoding="utf-8", errors="surrogateescape") as lines:
                lines.writelines(f"{place}\n" for place in new if "\n" not in place)


def is_trusted(path: str | Path) -> bool:
    """Return whether a path leads to a folder that the user trusts."""
    return real_path(path) in _trusted() - {""}


def real_path(path: str | Path) -> str:
    """Return an absolute path without symbolic links; return an empty text for an invalid path."""
    try:
        return os.path.realpath(path)
    except ValueError:  # realpath raises ValueError for a path with a null character.
        return ""


def _trusted() -> set[str]:
    try:
        return set(_trust_file().read_text(encoding="utf-8", errors="surrogateescape").split("\n"))
    except OSError:
        return set()


def _trust_file() -> Path:
    return cache_dir() / "trusted_folders.txt"


ENTRY_POINT_GROUP = "wheelleg_exp.packages"
FILE = "pyproject.toml"
# A folder that contains a file such as ``manifest.json`` is a run or sweep directory, not a user project.
_RECORDS = ("manifest.json", "pipeline.json", "sweep.json", "policy.json")
CONFIGS = "configs"
_ROOT = 0  # the administrator's user id
_SOURCES = ("", "src")  # The packages of a user project are in its root folder or in its folder ``src``.


@dataclass(frozen=True)
class Project:
    """A user's project: the folder of its ``pyproject.toml``, and its declared packages, such as ``mine.terms``."""

    root: Path
    packages: tuple[str, ...]

    @property
    def configs(self) -> Path:
        return self.root / CONFIGS

    def source(self, package: str) -> Path:
        """Return the project's folder that contains the top-level folder or module of the package ``package``."""
        top = package.split(".")[0]
        for folder in (self.root / name for name in _SOURCES):
            if (folder / top).is_dir() or (folder / f"{top}.py").is_file():
                return folder
        message, key = f"the project has no package '{top}'", f'project.entry-points."{ENTRY_POINT_GROUP}"'
        raise ConfigError(message, key=key, where=str(self.root / FILE), expected=f"a folder {self.root / top}")


def read_project(folder: Path) -> Project | None:
    """Return the user project in a folder; None if the folder's ``pyproject.toml`` declares no packages for configs."""
    file = folder / FILE
    try:
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
    except (OSError, UnicodeDecodeError):
        return None
    if ENTRY_POINT_GROUP not in text:
        return None
    import tomllib

    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"the file is not valid TOML: {error}", where=str(file)) from None
    declared: object = table
    for key in ("project", "entry-points", ENTRY_POINT_GROUP):
        declared = declared.get(key) if isinstance(declared, Mapping) else None
    if not isinstance(declared, Mapping) or not declared:
        return None
    return Project(folder, tuple(sorted(_package(value, file) for value in declared.values())))


def _package(value: object, file: Path) -> str:
    name = value.split(":")[0].strip() if isinstance(value, str) else ""
    parts = name.split(".")
    taken = parts[0] in sys.stdlib_module_names or parts[0] == "wheelleg_exp"
    if taken or not all(part.isidentifier() for part in parts):
        message, key = f"the project declares {value!r}", f'project.entry-points."{ENTRY_POINT_GROUP}"'
        raise ConfigError(message, key=key, where=str(file), expected="the name of a package of this project")
    return name


def current_project() -> Project | None:
    """Return the nearest user project around the current folder; ignore projects inside run or sweep directories."""
    here = Path.cwd()
    above = (here, *here.parents)
    records = [number for number, folder in enumerate(above) if any((folder / name).is_file() for name in _RECORDS)]
    for folder in above[records[-1] + 1 if records else 0 :]:
        project = read_project(folder)
        if project is not None:
            _require_own(project)
            return project
    return None


def _require_own(project: Project) -> None:
    # As in git, a project above the current folder is not trusted merely because the user works in the folder.
    owners = {path.stat().st_uid for path in (project.root, project.root / FILE)}
    if not owners <= {os.getuid(), _ROOT}:
        message = "this folder is in a project of another user, whose code and configs are used only on request"
        key = str(project.root)
        raise ConfigError(message, key=key, expected=f"--config-dir {project.configs} to trust it, or another folder")


def with_current(folders: Sequence[Path]) -> list[Path]:
    """Return the config folders, missing ones included, and that of the user project around the current folder."""
    found = [_resolved(folder) for folder in folders]
    try:
        project = current_project()
    except ConfigError as error:
        if error.key in {str(folder.parent) for folder in found}:  # A project named on the command line is trusted.
            return found
        raise
    if project is not None:
        join(project)
        if project.configs.is_dir() and project.configs.resolve() not in [folder.resolve() for folder in found]:
            found.append(project.configs)
    return found


def without_current(folders: Sequence[Path]) -> list[Path]:
    """Return the config folders without that of the current project, because commands always search this folder."""
    own: list[Path] = []
    with suppress(ConfigError):
        own = with_current([])
    return [folder for folder in folders if folder not in own]


def _resolved(folder: Path) -> Path:
    try:
        return config_folder(folder)
    except ConfigError:
        return folder


def config_folder(folder: Path) -> Path:
    """Return the absolute path of a config folder, given as a path, a project, or an installed package's name."""
    absolute = Path(folder).expanduser().absolute()
    if absolute.is_dir():
        project = read_project(absolute)
        return project.configs if project is not None and project.configs.is_dir() else absolute
    if str(folder) in installed_packages():  # Find an installed package's folder without importing the package.
        spec = importlib.util.find_spec(str(folder).split(".")[0])
        for place in spec.submodule_search_locations or () if spec is not None else ():
            for configs in (Path(place) / CONFIGS, *(above / CONFIGS for above in list(Path(place).parents)[:2])):
                inside = configs.parent == Path(place) or (configs.parent / FILE).is_file()
                if inside and configs.is_dir():
                    return configs
    parent = absolute.parent
    siblings = [p.name for p in parent.iterdir() if p.is_dir()] if parent.is_dir() else []
    raise ConfigError(
        "the config folder does not exist",
        key=str(folder),
        where="--config-dir",
        expected="a folder with YAML files, a project, or an installed package that declares itself",
        nearest=nearest_name(absolute.name, siblings),
    )


def installed_packages() -> tuple[str, ...]:
    """Return the names of the packages that installed distributions declare as callable from configs."""
    from importlib import metadata  # A module-level import would slow down each command.

    points = metadata.entry_points(group=ENTRY_POINT_GROUP)
    return tuple(sorted({point.value.split(":")[0] for point in points}))


# --- import of the packages that user projects declare ---

_joined: dict[str, Project] = {}


def join(project: Project) -> None:
    """Allow configs to call the packages that a user project declares, until the process ends."""
    for package in project.packages:
        _joined[package] = project


def join_recorded(folders: Sequence[Path], recorded: Sequence[str]) -> list[Path]:
    """Allow configs to call functions of the user projects that contain ``folders`` (default: a run's config folders).

    A recorded folder must exist, and be trusted or in the current project; otherwise, ``left_out`` lists it.
    """
    found = [config_folder(folder) for folder in folders] or own_folders(recorded)
    if not folders:
        for project in filter(None, (read_project(folder.parent) for folder in found)):
            _require_own(project)
    for folder in found:
        join_folder(folder)
    return found


def own_folders(recorded: Iterable[str]) -> list[Path]:
    """Return the recorded config folders of a run that the user trusts, or that belong to a project in use."""
    in_use = {real_path(project.configs) for project in _joined.values()}
    own = (folder for folder in recorded if real_path(folder) in in_use or is_trusted(folder))
    return [Path(folder) for folder in own if Path(folder).is_dir()]


def left_out(recorded: Iterable[str], found: Sequence[Path]) -> dict[str, str]:
    """Map each recorded config folder that is not in ``found`` to the reason for its omission, such as ``is gone``."""
    used = {real_path(folder) for folder in found}
    others = [folder for folder in recorded if real_path(folder) not in used]
    return {folder: "is not one of your trusted folders" if is_there(folder) else "is gone" for folder in others}


def is_there(folder: str | Path) -> bool:
    """Return whether a folder exists; return False for an invalid folder name."""
    try:
        return Path(folder).is_dir()
    except OSError:  # The operating system rejects the folder's name, for example because the name is too long.
        return False


def join_folder(folder: Path) -> None:
    """If ``folder`` is a user project's config folder, allow configs to call the packages that the project declares."""
    project = read_project(folder.parent) if folder.name == CONFIGS else None
    if project is not None:
        join(project)


def forget(root: Path) -> None:
    """Forbid configs to call packages of the user project in ``root``; remove its modules from ``sys.modules``."""
    for package in [name for name, project in _joined.items() if project.root == root]:
        del _joined[package]
        top = package.split(".")[0]
        if _finder.sources.pop(top, None) is not None:
            for module in [name for name in sys.modules if name == top or name.startswith(f"{top}.")]:
                del sys.modules[module]


def joined_packages() -> tuple[str, ...]:
    """Return the names of all packages of user projects that configs can call."""
    return tuple(_joined)


def project_of(package: str) -> Project | None:
    """Return the user project that declares a package with the top-level name of ``package``, or None."""
    top = package.split(".")[0]
    return next((project for name, project in _joined.items() if name.split(".")[0] == top), None)


def make_importable(target: str) -> None:
    """Make the package in a dotted path, such as ``my_pkg.rewards.track``, importable if a user project declares it."""
    package = next((name for name in _joined if target.startswith(f"{name}.")), None)
    if package is None:
        return
    top = package.split(".")[0]
    source = _joined[package].source(package)
    loaded = sys.modules.get(top)
    if loaded is not None and not Path(_place(loaded)).resolve().is_relative_to(source.resolve()):
        message = f"the package '{top}' has already been imported from elsewhere, {_place(loaded)}"
        raise ConfigError(message, expected=f"the one in {source}")
    _finder.sources[top] = source
    if _finder not in sys.meta_path:
        sys.meta_path.insert(0, _finder)


def make_classes_importable(node: object) -> None:
    """Call ``make_importable`` for every ``class_name`` in an agent config; rsl_rl imports the classes."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            if key == "class_name":
                make_importable(str(value).replace(":", "."))
            make_classes_importable(value)


def _place(module: ModuleType) -> str:
    return str(getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), "nowhere"))


class _Finder(MetaPathFinder):
    def __init__(self) -> None:
        self.sources: dict[str, Path] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        source = self.sources.get(fullname) if path is None else None
        return PathFinder.find_spec(fullname, [str(source)], target) if source is not None else None


_finder = _Finder()
