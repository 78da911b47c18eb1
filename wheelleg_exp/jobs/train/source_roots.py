"""Find the source folders of a training, and compare a run's source code and machine with the current ones."""

from __future__ import annotations

import functools
import importlib.util
import itertools
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.files import sha256
from wheelleg_exp.packages import installed_packages, is_trusted, joined_packages, project_of, read_project, real_path
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.run import environment
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_changes import SourceRecord, describe_changes
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.run.source_snapshot import is_installed, snapshot_source
from wheelleg_exp.verify.run_differences import SECTIONS, FactDifference, environment_differences

_PACKAGE = "wheelleg_exp"
_CALLS = ("_target_", "class_name")


def source_roots(composed: Composed) -> list[Path]:
    """Return the folders whose source code a training depends on; the folder of this package comes first.

    Packages that keys such as ``_target_`` name belong to them. The folder of the robot's file does not, because a run
    directory contains a copy of the robot.
    """
    folders = list(composed.config_dirs)
    for source in composed.loader.repository_used.get_sources():
        path = Path(source.path)
        if source.scheme() == "file" and path.resolve() != configs_dir().resolve():
            folders.append(path)
        elif source.scheme() == "pkg" and (root := _package_root(source.path)) is not None:
            folders.append(root)
    roots = [configs_dir().parent, *(folder.parent if read_project(folder.parent) else folder for folder in folders)]
    called = set(_called_names(composed.config))
    declared = sorted({*installed_packages(), *joined_packages()})
    names = (name for name in declared if any(call.startswith(f"{name}.") for call in called))
    return _unique([*roots, *(root for name in names if (root := _package_root(name)) is not None)])


def loaded_outside(roots: Sequence[Path]) -> list[Path]:
    """Return the imported packages that are not in ``roots``, the standard library, or a virtual environment."""
    # Modules imported through ``PYTHONPATH``, the working directory, or a ``.pth`` file may affect the training.
    known = [root.resolve() for root in roots] + _python_folders()
    found = []
    for name in sorted({name.partition(".")[0] for name in list(sys.modules)}):
        for place in _places(sys.modules.get(name)):
            if not is_installed(place) and not any(place.is_relative_to(folder) for folder in known):
                found.append(place)
    return _unique(found)


def module_digests() -> dict[str, str]:
    """Return the sha256 of the file of each imported module that is neither installed nor part of this package."""
    modules = sorted(sys.modules.items())
    tops = {name: _places(module) for name, module in modules if "." not in name}
    own = {n for n, places in tops.items() if n not in (_PACKAGE, "__main__") and not all(map(is_installed, places))}
    files = {n: getattr(module, "__file__", None) for n, module in modules if n.partition(".")[0] in own}
    return {n: sha256(Path(f)) for n, f in files.items() if isinstance(f, str) and Path(f).is_file()}


def _called_names(node: object) -> Iterator[str]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            if key in _CALLS and isinstance(value, str):
                yield value.replace(":", ".")
            yield from _called_names(value)
    elif isinstance(node, list):
        for value in node:
            yield from _called_names(value)


def _package_root(name: str) -> Path | None:
    """Return the folder of a package's project, or else of the package itself, without importing the package."""
    top = name.replace("/", ".").partition(".")[0]
    if top in (_PACKAGE, "hydra"):
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


def _places(module: object) -> list[Path]:
    folders = [Path(place) for place in getattr(module, "__path__", ()) if isinstance(place, str)]
    file = getattr(module, "__file__", None)
    found = folders or ([Path(file)] if isinstance(file, str) else [])
    # Compare unresolved paths, because ``sitecustomize`` in Python's library folder can be a symbolic link.
    own = [path for path in found if path.is_absolute() and not any(path.is_relative_to(f) for f in _python_folders())]
    return [path.resolve() for path in own if path.exists()]


@functools.cache
def _python_folders() -> list[Path]:
    paths = sysconfig.get_paths()
    return [Path(paths[key]).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib", "scripts")]


def _unique(paths: Iterable[Path]) -> list[Path]:
    return list({path.resolve(): path for path in reversed(list(paths))}.values())[::-1]


def shorten(value: object) -> str:
    """Return ``value`` as a text of at most 60 characters."""
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def differences_now(
    run: RunDirectory, threads: Mapping[str, object], config_dirs: Sequence[Path]
) -> list[FactDifference]:
    """Return how this process differs from a run in source, versions, hardware, threads, and environment variables.

    Differences that cannot change training results are omitted. ``set_threads`` returned ``threads``.
    """
    now = ProcessFacts(
        versions=environment.versions(),
        hardware=environment.hardware(),
        threads=threads,
        environment_variables=environment.variables(),
        modules=module_digests(),
    )
    facts = environment_differences(run.manifest().facts.processes, [now])
    return _source_differences(run, config_dirs) + [f for f in facts if f.section in SECTIONS[:2] or f.allows]


def _source_differences(run: RunDirectory, config_dirs: Sequence[Path]) -> list[FactDifference]:
    recorded = load_source(run)
    with tempfile.TemporaryDirectory() as folder:
        present = snapshot_source(_run_roots(run, config_dirs), Path(folder), runs_root=run.root)
    found = []
    for number, (was, now) in enumerate(itertools.zip_longest(recorded, present)):
        (key, before), (key_now, after) = _identity(was), _identity(now)
        if (key, before) != (key_now, after) or not before:
            note = describe_changes(was, now, [Path(now.root)] if now and now.root else [])
            name = f"{key if key == key_now else 'source'} ({number + 1})"
            found.append(FactDifference("source", name, before or key, after or key_now, note=note))
    return found


def _identity(record: SourceRecord | None) -> tuple[str, str]:
    """Return the git tree or content hash of a recorded source folder, as a pair of name and value."""
    if record is None:
        return "(not kept)", ""
    return ("tree", record.tree) if record.tree else ("content_sha256", record.content_sha256 or "")


def _run_roots(run: RunDirectory, config_dirs: Sequence[Path]) -> list[Path]:
    """Return the present places of the run's source roots: this package's, then the projects of the config folders."""
    # Recorded source folders are used only if the user trusts them, or if they are installed or imported here.
    projects = [folder.parent if read_project(folder.parent) else folder for folder in config_dirs]
    recorded = [Path(record.root) / name for record in load_source(run) if record.root for name in record.folders]
    known = [configs_dir().parent, *projects]
    installed = [root for name in installed_packages() if (root := _package_root(name)) is not None]
    used = {real_path(path) for path in [*loaded_outside(known), *installed]}
    return [*known, *(p for p in recorded[1:] if (real_path(p) in used or is_trusted(p)) and p.exists())]
