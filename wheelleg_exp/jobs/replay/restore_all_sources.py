"""Restore the source of a run for a replay: every recorded tree in its own folder, and which packages each provides."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, read_yaml
from wheelleg_exp.jobs.replay.restored_imports import ENTRIES
from wheelleg_exp.packages import CONFIGS, is_there, read_project
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_changes import SourceRecord
from wheelleg_exp.run.source_restore import find_origin, load_source, restore_source
from wheelleg_exp.run.source_snapshot import content_digest, is_installed

PACKAGE = "wheelleg_exp"
_UNSAFE = re.compile(r"[^\w.-]")


@dataclass(frozen=True)
class RestoredTree:
    """A source folder of a run, and the place from which its content was restored."""

    root: str
    how: str  # ``how`` is 'restored', 'installed', 'in place' (the present folder is used), or 'missing'.
    commit: str | None = None
    tree: str | None = None
    origin: str | None = None  # the git repository from which the recorded commit was read


@dataclass
class RestoredSource:
    """All source folders that were restored for a replay of a run."""

    trees: list[RestoredTree] = field(default_factory=list)  # ``trees[0]`` is the source folder of wheelleg_exp.
    places: dict[str, Path] = field(default_factory=dict)  # maps each package name to the package's parent folder
    config_dirs: list[Path] = field(default_factory=list)
    projects: list[Path] = field(default_factory=list)
    source_roots: list[Path] = field(default_factory=list)  # the run's source folders, except that of wheelleg_exp
    moved: dict[str, Path] = field(default_factory=dict)  # maps each source folder of the run to its restored copy
    notes: list[str] = field(default_factory=list)

    def now(self, path: str) -> Path:
        """Return the present path of a recorded path: in a restored folder, or unchanged."""
        found = [root for root in self.moved if Path(path).is_relative_to(root)]
        if not found:
            return Path(path)
        root = max(found, key=len)
        return self.moved[root] / Path(path).relative_to(root)

    def facts(self) -> list[dict[str, object]]:
        """Return the path, the commit, and the origin of each restored source folder as a dictionary."""
        return [asdict(tree) for tree in self.trees]


def describe_code(run: RunDirectory) -> str:
    """Return a sentence about the source code that a replay of the run executes."""
    main, *others = load_source(run)
    if main.commit:
        patch = f" plus the run's patch ({main.patch_bytes} bytes)" if main.patch_bytes else ""
        code = f"the code of commit {main.commit[:12]}{patch}"
    elif main.patch:
        code = f"the code that the run recorded ({main.patch_bytes} bytes)"
    else:
        code = f"the installed {PACKAGE}"
    further = sum(1 for entry in others if entry.patch)
    more = f", and the code of {further} more source folder{'s' if further > 1 else ''} of it" if further else ""
    return f"replay runs {code}{more}, with all the rights of this user"


def restore_all(run: RunDirectory, workplace: Path, repositories: Sequence[Path]) -> RestoredSource:
    """Restore every source folder that a run recorded, as a subfolder of the existing folder ``workplace``.

    A recorded commit may be in ``repositories``, in the run's original source folder, or in the current checkout.
    RunDirectoryError means that the package's source was not recorded, was not found, or is too old.
    """
    source = RestoredSource()
    for number, record in enumerate(load_source(run)):
        candidates = [*repositories, Path(record.root or "."), configs_dir().parent, Path.cwd()]
        if record.patch is not None:
            _restore(run, number, record, workplace, candidates, source)
        elif number == 0:
            if record.status != "installed":
                message = f"the source of the run was not captured ({record.status}): {record.note}"
                raise RunDirectoryError(message, expected="a run whose source was captured")
            package = configs_dir().parent
            if not is_installed(package) or content_digest(package) != record.content_sha256:
                what = f"its files are not those of '{package}', which trains now"
                source.notes.append(f"the run was made by an installed {PACKAGE}; {what}")
            source.trees.append(RestoredTree(record.root or ".", "installed"))
            source.places[PACKAGE] = Path(__file__).resolve().parents[3]
        else:
            _use_in_place(record, source)
    folders = run.manifest().facts.config_dirs
    if folders is None:
        folders = ()
        with suppress(KeyError, TypeError):
            entries = read_yaml(run.hydra / "hydra.yaml")["hydra"]["runtime"]["config_sources"]
            entries = [entry for entry in entries if entry["schema"] == "file" and entry["provider"] != "main"]
            folders = tuple(str(entry["path"]) for entry in entries)
    source.config_dirs = [folder for folder in dict.fromkeys(map(source.now, folders)) if is_there(folder)]
    for folder in source.source_roots:
        _register(folder, source)
    return source


def _restore(
    run: RunDirectory, number: int, record: SourceRecord, work: Path, clones: list[Path], source: RestoredSource
) -> None:
    # Give the restored source folder the original folder's name, because imports can depend on the name.
    root = record.root or "."
    name = _UNSAFE.sub("_", Path(root).name).strip(".") or "source"
    destination = work / "source" / str(number) / name
    with for_people(destination.parent):
        destination.parent.mkdir(parents=True)
    try:
        origin = find_origin(record, clones)
    except RunDirectoryError:
        if number == 0:
            raise
        _use_in_place(record, source)
        return
    tree, place = restore_source(run, destination, origin, which=number), str(origin) if origin else None
    source.trees.append(RestoredTree(root, "restored", record.commit, tree, place))
    source.moved[root] = destination
    folders = [destination / name for name in record.folders]
    if number == 0:
        folder = folders[0]
        if not any((folder / PACKAGE / f"{entry}.py").is_file() for entry in ENTRIES):
            version = record.commit[:12] if record.commit else "the run's source"
            raise RunDirectoryError(
                f"the source code of {version} is too old for a replay, because {PACKAGE}/{ENTRIES[-1]}.py is missing",
                expected=f"a newer run; this one repeats by hand: check {version} out, apply source/source.patch, "
                "and give 'wheelleg train' the overrides in .hydra/overrides.yaml",
            )
        source.places[PACKAGE] = folders.pop(0)
    # Add a note to the replay's output for each source file that the original run did not store.
    for entry in record.refused:
        now = "is as committed" if os.path.lexists(destination / entry["path"]) else "is missing"
        source.notes.append(f"'{entry['path']}' was not captured with the run ({entry['reason']}) and {now}")
    nested = [entry["path"] for entry in record.submodules]
    if nested:
        source.notes.append(f"submodules were not captured with the run, and are empty: {', '.join(nested)}")
    source.source_roots += folders


def _register(folder: Path, source: RestoredSource) -> None:
    """Register a restored folder or module: as a project, or as a package or module to import."""
    if folder.is_file():
        source.places.setdefault(folder.stem, folder.parent)
    elif read_project(folder) is not None:
        source.projects.append(folder)
    elif folder.name == CONFIGS and read_project(folder.parent) is not None:
        source.projects.append(folder.parent)
    elif folder not in source.config_dirs:
        while (folder.parent / "__init__.py").is_file():
            folder = folder.parent
        source.places.setdefault(folder.name, folder.parent)


def _use_in_place(record: SourceRecord, source: RestoredSource) -> None:
    """Use the present files of a source folder that the run did not save; if they may have changed, add a note."""
    root, status = Path(record.root or "."), record.status
    digest = record.content_sha256
    unchanged = digest is not None and root.exists() and content_digest(root) == digest
    if unchanged or (status == "no_repository" and not record.patch and root.exists()):
        if not unchanged:
            source.notes.append(f"'{root}' was not captured with the run, and is used as it is now")
        source.trees.append(RestoredTree(str(root), "in place"))
        source.source_roots.append(root)
        return
    if status == "installed":
        name = record.distribution or str(root)
        source.notes.append(f"the run used the installed {name}; the package installed here may differ")
    else:
        missing = f"no repository here contains commit {str(record.commit)[:12]}; see --repository"
        reason = missing if record.patch else status
        instead = "an installed package replaces it, if there is one"
        source.notes.append(f"'{root}' cannot be restored ({reason}); {instead}")
    source.trees.append(RestoredTree(str(root), "installed" if status == "installed" else "missing", record.commit))
