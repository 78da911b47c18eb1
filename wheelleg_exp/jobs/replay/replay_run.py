"""Replay a run: restore its source, train again from its snapshot alone, and compare with the original.

A run can be replayed if the run has ended and its snapshot files have the sha256 that the run's manifest records.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from wheelleg_exp.child_process import Child, Event, job_events
from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import for_people, read_text, read_yaml, sha256
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.replay import restored_imports
from wheelleg_exp.jobs.replay.restored_imports import ENTRIES
from wheelleg_exp.jobs.replay.snapshot_training import PROTOCOL, Request
from wheelleg_exp.jobs.train.source_roots import shorten
from wheelleg_exp.packages import CONFIGS, is_there, read_project
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.rl.trainer import Iteration
from wheelleg_exp.run.environment import hardware, replay_environ, requested_variables, variables, versions
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import read_log
from wheelleg_exp.run.manifest import SNAPSHOT, Manifest
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.run_config import OVERRIDES, recorded_config
from wheelleg_exp.run.run_directory import NEEDED, REPLAYS, RunDirectory
from wheelleg_exp.run.run_lock import is_alive
from wheelleg_exp.run.source_changes import SourceRecord
from wheelleg_exp.run.source_restore import find_origin, load_source, restore_source
from wheelleg_exp.run.source_snapshot import content_digest, is_installed
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.verify import Comparison, FactDifference, compare_runs, environment_differences
from wheelleg_exp.verify.run_differences import UNKNOWN_BEFORE_TORCH
from wheelleg_exp.verify.run_parts import measure

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


_SNAPSHOT_FILES = (*NEEDED, OVERRIDES, "source/git.json")


def iterations_to_train(run: RunDirectory, manifest: Manifest, wanted: int | None) -> int:
    """Return how many iterations a replay trains: those of the run, or fewer."""
    if manifest.status == "running" and is_alive(manifest.facts.process):
        raise RunDirectoryError(f"run '{run.id}' is still running", expected="a run that has ended")
    there = len(read_log(run.iterations).lines)
    if not there:
        raise RunDirectoryError(f"run '{run.id}' has no finished iteration to compare", where=str(run.iterations))
    if wanted is not None and not 1 <= wanted <= there:
        raise RunDirectoryError(f"is {wanted}", key="--iterations", expected=f"from 1 to the {there} that the run has")
    return there if wanted is None else wanted


def require_whole_snapshot(run: RunDirectory, manifest: Manifest) -> None:
    """Raise RunDirectoryError if snapshot files are missing or changed, or if several processes trained the run."""
    if manifest.matches_digest() is False:
        message = "the manifest was changed after the run wrote it"
        raise RunDirectoryError(message, where=str(run.path / MANIFEST_NAME), expected="an unchanged run")
    processes = manifest.facts.ranks.world_size if manifest.facts.ranks else 1
    if processes > 1:
        message = f"run '{run.id}' was trained by {processes} processes, and a replay trains with one"
        expected = "'wheelleg train' again with the recorded command under torchrun, and 'wheelleg verify A B'"
        raise RunDirectoryError(message, expected=expected)
    recorded = {name: entry for name, entry in manifest.facts.files.items() if name.startswith(SNAPSHOT)}
    absent = next((name for name in _SNAPSHOT_FILES if name not in recorded), None)
    if absent is not None:
        message = f"the snapshot of run '{run.id}' is not whole: its manifest names no {absent}"
        raise RunDirectoryError(message, expected="a run that got as far as its first iteration")
    for name, entry in recorded.items():
        path = run.inside(name)
        if not path.is_file():
            raise RunDirectoryError(f"{name} is missing", where=str(path), expected="a run with its whole snapshot")
        if sha256(path) != entry["sha256"]:
            message = f"{name} is not what the manifest recorded"
            raise RunDirectoryError(message, where=str(path), expected="a snapshot nobody has changed")
    folders = (run.hydra, run.params, run.source, run.asset)
    for path in (path for folder in folders for path in sorted(folder.rglob("*"))):
        name = path.relative_to(run.path).as_posix()
        if name not in recorded and not path.is_dir():
            message = f"the run's manifest lacks the file {name}"
            raise RunDirectoryError(message, where=str(path), expected="the run's own files")


KIND = "replay"


@dataclass(frozen=True)
class Replayed:
    """The result of a replay (a repeated training), with the comparison of the original run and the new run."""

    original: RunDirectory
    run: RunDirectory
    iterations: int
    whole: bool  # True if the replay repeated all iterations of the original run.
    source: RestoredSource
    machine: list[FactDifference]
    composed: Mapping[str, object]  # ``equal`` is true if the run's overrides still give the config that the run saved.
    asset: Mapping[str, object]  # ``note`` explains why the replay did not convert the robot again.
    notes: list[str]
    kept: Path | None  # the folder of the restored source code, or None if this folder was removed
    comparison: Comparison

    def as_dict(self) -> dict[str, object]:
        """Return the result of the replay as one JSON document."""
        return {
            "run": str(self.original.path),
            "replay": str(self.run.path),
            "verdict": self.comparison.verdict,
            "iterations": self.iterations,
            "all_iterations": self.whole,
            "source": self.source.facts(),
            "machine": [vars(difference) for difference in self.machine],
            "composed": self.composed,
            "asset": self.asset,
            "notes": self.notes,
            "kept": None if self.kept is None else str(self.kept),
            "comparison": self.comparison.as_dict(),
        }


def replay(
    run: RunDirectory,
    command: Sequence[str],
    display: Display,
    stop: StopRequest,
    *,
    root: Path,
    repositories: Sequence[Path] = (),
    iterations: int | None = None,
    keep: bool = False,
) -> Replayed:
    """Train a run again from its snapshot, in ``<root>/replays/<task>/``, and compare the new run with the original.

    The original run and the user's repositories stay unchanged. ``repositories`` are git clones that may contain the
    commits of the run. ``iterations`` defaults to all. With ``keep``, the restored source code remains.
    """
    manifest = run.manifest()
    require_whole_snapshot(run, manifest)
    _config(run, manifest)  # Detect errors in the replay's config before the source code is restored.
    total = iterations_to_train(run, manifest, iterations)
    display.note(describe_code(run))
    with _workplace(keep) as workplace:
        stop.check()
        source = _restored(run, workplace, repositories, stop)
        notes = [f"{name} {what}: a damaged file is never identical" for name, what in measure(run).damage.items()]
        notes += [*_resume_notes(manifest), *source.notes]
        environ = _environ(run, manifest)
        now = ProcessFacts(versions=versions(), hardware=hardware(), environment_variables=variables(environ))
        unknown = (*UNKNOWN_BEFORE_TORCH, "wheelleg_exp")  # The restored source has the version of the run.
        machine = environment_differences(manifest.facts.processes, [now], unknown)
        _report(display, source, machine, notes)
        stop.check()
        request = _request(run, manifest, total, root, workplace, source, command)
        folder = source.now(manifest.facts.working_directory or "/")
        # If the restored source code lacks the run's working directory, train in an empty folder.
        if not (folder.is_dir() and folder.is_relative_to(workplace)):
            folder = workplace / "here"
        events = _train(request, source, environ, folder, display, stop)
    new = RunDirectory.open(events["run"]["path"], root)
    comparison = compare_runs(run, new, iterations=total)
    results = {"of": manifest.facts.id or run.id, "verdict": comparison.verdict, "iterations": total}
    new.manifest().add(KIND, results=results, command=command)
    return Replayed(
        original=run,
        run=new,
        iterations=total,
        whole=total == len(read_log(run.iterations).lines),
        source=source,
        machine=machine,
        composed={key: value for key, value in events.get("composed", {}).items() if key != "event"},
        asset={key: value for key, value in events.get("asset", {}).items() if key != "event"},
        notes=notes,
        kept=workplace / "source" if keep else None,
        comparison=comparison,
    )


def _restored(run: RunDirectory, workplace: Path, repositories: Sequence[Path], stop: StopRequest) -> RestoredSource:
    try:
        return restore_all(run, workplace, repositories)
    except WheellegError:
        stop.check()  # Ctrl-C also interrupts git, so that git's error can mean that the user stopped the replay.
        raise


def _resume_notes(manifest: Manifest) -> list[str]:
    """Return notes about the resumes of a run, because a replay trains without interruption."""
    entries = manifest.facts.resumes
    notes = []
    if entries:
        times = {1: "once", 2: "twice"}.get(len(entries), f"{len(entries)} times")
        notes.append(f"the run was stopped and resumed {times}; the replay trains without a stop")
    for entry in entries:
        if not entry.overrides if entry.exact is None else entry.exact:
            continue
        at = f" before iteration {entry.iteration}" if entry.iteration is not None else ""
        why = "; ".join(entry.why) or " ".join(entry.overrides)
        text = f"a resume{at} was not exact ({why}): the replay uses the last config from its start, so that its "
        notes.append(text + "numbers will differ")
    return notes


def _environ(run: RunDirectory, manifest: Manifest) -> dict[str, str]:
    recorded = _recorded_variables(manifest)
    asked_for = requested_variables([read_text(run.hydra / "config.yaml")])
    environ = replay_environ(recorded, also=asked_for)
    if manifest.facts.config_variables is None:
        return environ
    # Remove environment variables that the config reads but that were not set in the original run.
    # Keep variables with secrets (such as API keys), because no manifest records them.
    in_vain = set(variables(environ, also=asked_for)) & set(asked_for) - set(recorded)
    return {name: value for name, value in environ.items() if name not in in_vain}


def _config(run: RunDirectory, manifest: Manifest) -> dict[str, object]:
    """Return the config of a replay; recorded environment variables replace the variables of this process."""
    return recorded_config(run, {**os.environ, **_recorded_variables(manifest)})


def _recorded_variables(manifest: Manifest) -> dict[str, str]:
    return {**(manifest.facts.environment_variables or {}), **(manifest.facts.config_variables or {})}


def _report(display: Display, source: RestoredSource, machine: list[FactDifference], notes: list[str]) -> None:
    for tree in source.trees:
        if tree.tree is not None:
            commit = f"commit {tree.commit[:12]} from {tree.origin}" if tree.commit else "its patch alone"
            display.note(f"source: tree {tree.tree[:12]} restored ({commit})")
        else:
            display.note(f"source: {tree.root}: {tree.how}")
    for difference in machine:
        why = f" ({difference.allows})" if difference.allows else ""
        display.note(f"differs: {difference.name} was {shorten(difference.a)}, is {shorten(difference.b)}{why}")
    if not machine:
        display.note("versions, hardware and variables are those of the run")
    for note in notes:
        display.note(f"note: {note}")


@contextmanager
def _workplace(keep: bool) -> Iterator[Path]:
    """Yield a temporary folder; if ``keep`` is true, a successful replay leaves the restored source code there."""
    with for_people(Path(tempfile.gettempdir())):
        folder = Path(tempfile.mkdtemp(prefix="wheelleg-replay-")).resolve()
    kept = False
    try:
        (folder / "here").mkdir()
        yield folder
        kept = keep
    finally:
        for path in folder.iterdir() if kept else [folder]:
            if path.name != "source":
                shutil.rmtree(path, ignore_errors=True)


def _request(
    run: RunDirectory,
    manifest: Manifest,
    until: int,
    root: Path,
    workplace: Path,
    source: RestoredSource,
    command: Sequence[str],
) -> Request:
    options = _config(run, manifest)["run"]
    name = options.get("name") if isinstance(options, Mapping) else None
    facts = {
        "replay_of": manifest.facts.id or run.id,  # The folder of a copied run can have another name.
        "replay": {
            "manifest_sha256": sha256(run.path / MANIFEST_NAME),
            "snapshot": {k: v["sha256"] for k, v in manifest.facts.files.items() if k.startswith(SNAPSHOT)},
            "iterations": until,
            "source": source.facts(),
        },
    }
    return Request(
        protocol=PROTOCOL,
        run=str(run.path),
        until=until,
        root=str((root / REPLAYS).absolute()),
        name=f"{name}_{KIND}" if name else KIND,
        workplace=str(workplace),
        config_dirs=[str(folder) for folder in source.config_dirs],
        projects=[str(folder) for folder in source.projects],
        source_roots=[str(folder) for folder in source.source_roots],
        moved={before: str(after) for before, after in source.moved.items()},
        command=list(command),
        facts=facts,
    )


def _train(
    request: Request, source: RestoredSource, environ: dict[str, str], folder: Path, display: Display, stop: StopRequest
) -> dict[str, Event]:
    """Train a run again in a child process; return the child's last message of each type."""
    # With the option -P, Python imports nothing from the working directory.
    # Pass the code of the child process as text, so that the child imports no file of the current ``wheelleg_exp``.
    code = Path(restored_imports.__file__).read_text(encoding="utf-8")
    places = json.dumps({name: str(place) for name, place in source.places.items()})
    last: dict[str, Event] = {}
    try:
        child = Child((sys.executable, "-P", "-c", code, places), request.line(), environ, folder)
        with job_events(child, stop) as events:
            for event in events:
                last[event["event"]] = event
                _show(event, source, display)
    except WheellegError as error:
        error.message = f"the training from the snapshot failed: {error.message}"
        raise
    return last


def _show(event: Event, source: RestoredSource, display: Display) -> None:
    kind = event["event"]
    if kind == "began":
        expected = (source.places["wheelleg_exp"] / "wheelleg_exp").resolve()
        if Path(event["package"]).resolve() != expected:
            message = f"the training imported '{event['package']}'"
            raise RunDirectoryError(message, expected=f"the restored '{expected}'")
    elif kind == "note":
        display.note(event["text"])
    elif kind == "composed":
        same = "compose to the snapshot's config with the restored files"
        how = same if event["equal"] else f"do not {same}: {event['difference']}"
        display.note(f"config: the recorded overrides {how}")
    elif kind == "asset":
        display.note(f"robot: {event['note'] or 'converted again from the restored source, to the same MJCF'}")
    elif kind == "run":
        display.note(f"run directory: {event['path']}")
    elif kind == "iteration":
        display.iteration(Iteration(event["done"] - 1, event["scalars"], 0), event["total"])
