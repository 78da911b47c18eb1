"""Store the state of the source tree with the run: a commit, a tree id, and a patch that restores the tree.

``git.json`` describes the repository of each source folder, the main one first. ``source.patch``
(``source_2.patch`` for a second repository) makes the recorded tree from the recorded commit, untracked and binary
files included. Ignored files and the folder of runs are left out.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.files import sha256, write_bytes, write_json
from wheelleg_exp.run.git_commands import (
    GitError,
    GitMissing,
    Repository,
    borrowed_folder,
    filters,
    join_nul,
    run_git,
    scratch_index,
    split_nul,
)
from wheelleg_exp.run.secrecy import secret_content, secret_name, without_credentials
from wheelleg_exp.run.source_changes import state

_INSTALL_FOLDERS = ("site-packages", "dist-packages")


def is_installed(root: Path, above: Path | None = None) -> bool:
    """Return whether ``root`` lies in an environment's folder of packages, as seen from the folder ``above``."""
    parts = root.parts if above is None else root.relative_to(above).parts
    return any(part in _INSTALL_FOLDERS for part in parts)


def distribution_of(root: Path) -> str | None:
    """Return ``name==version`` of the distribution that a package's folder or file belongs to, if one says so."""
    places = [place for place in root.parents if place.name in _INSTALL_FOLDERS]
    if not places:
        return None
    top = root.relative_to(places[0]).parts[0]
    for found in metadata.distributions(path=[str(places[0])]):
        if any(file.parts and file.parts[0] == top for file in found.files or ()):
            return f"{found.metadata['Name']}=={found.version}"
    return None


def content_digest(root: Path) -> str:
    """Return one sha256 over names and contents of the readable files at ``root``, bytecode left out."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if path.is_file() and "__pycache__" not in path.parts and os.access(path, os.R_OK):
            digest.update(os.fsencode(path.relative_to(root)) + b"\0" + sha256(path).encode() + b"\n")
    return digest.hexdigest()


# A filter that only moves content elsewhere: with it off, git keeps the content itself.
_HARMLESS_FILTERS = ("lfs",)
_VIRTUAL_ENVIRONMENT = "pyvenv.cfg"

_GITLINK = "160000"
_NO_MODE = "000000"


@dataclass(frozen=True)
class Refused:
    """A file whose state is not kept, and why."""

    path: str
    reason: str


@dataclass(frozen=True)
class ChangedPath:
    """How one path of the index differs from the base: modes and blob ids, zeros for none."""

    path: str
    old_mode: str
    old_id: str
    new_mode: str
    new_id: str

    def blobs(self) -> list[str]:
        """Return the ids of the contents before and after, as far as there are any."""
        sides = ((self.old_mode, self.old_id), (self.new_mode, self.new_id))
        return [blob for mode, blob in sides if mode not in (_NO_MODE, _GITLINK)]


def untracked_files(repository: Repository, runs_root: Path | None) -> tuple[list[str], list[Refused]]:
    """Return the untracked files to keep, and those refused; ignored files and runs are in neither.

    Nor is the output of this process where it goes to a file. A virtual environment is refused as a whole.
    """
    kept: list[str] = []
    runs = _relative_to_top(repository, runs_root)
    paths = repository.paths("ls-files", "--others", "--exclude-standard", "-z")
    environments = {p.removesuffix(_VIRTUAL_ENVIRONMENT) for p in paths if p.endswith(f"/{_VIRTUAL_ENVIRONMENT}")}
    refused = [Refused(folder, "it is a virtual environment") for folder in sorted(environments)]
    filtered, output = _filtered(repository, paths), _output_files()
    for path in paths:
        if output and _identity(repository.top / path) in output:
            continue
        if runs is not None and Path(path).is_relative_to(runs):
            continue
        if any(path.startswith(folder) for folder in environments):
            continue
        reason = _reason_against(repository, path) or filtered.get(path)
        if reason is None:
            kept.append(path)
        else:
            refused.append(Refused(path, reason))
    return kept, refused


def _output_files() -> set[tuple[int, int]]:
    """Return the identities of the files that this process and its parent print to; a sweep prints for its jobs.

    What goes through a pipe, as to ``tee``, cannot be seen.
    """
    printed = [Path(f"/proc/{pid}/fd/{number}") for pid in (os.getpid(), os.getppid()) for number in (1, 2)]
    found = {_identity(path, follow=True) for path in printed}
    for number in (1, 2):
        with suppress(OSError):
            found.add(_identity_of(os.fstat(number)))
    return {identity for identity in found if identity is not None}


def _identity(path: Path, *, follow: bool = False) -> tuple[int, int] | None:
    try:
        return _identity_of(path.stat() if follow else path.lstat())
    except OSError:
        return None


def _identity_of(facts: os.stat_result) -> tuple[int, int] | None:
    return (facts.st_dev, facts.st_ino) if stat.S_ISREG(facts.st_mode) else None


def file_sizes(repository: Repository, paths: list[str]) -> dict[str, int]:
    """Return the sizes in bytes; 0 for a file that is gone by now."""
    sizes = {}
    for path in paths:
        try:
            sizes[path] = (repository.top / path).lstat().st_size
        except OSError:
            sizes[path] = 0
    return sizes


def add_everything(scratch: Repository, untracked: list[str]) -> list[Refused]:
    """Bring a scratch index to the state of the working tree; return the changed files that git cannot read."""
    _forget_promises(scratch)
    refused = _add_tracked(scratch)
    # --remove, because a file may be gone again by now.
    scratch.run("update-index", "--add", "--remove", "--replace", "-z", "--stdin", stdin=join_nul(untracked))
    return refused


def _add_tracked(scratch: Repository) -> list[Refused]:
    """Bring what is tracked to the state of the working tree.

    Submodules are left out and set to their commits by themselves: git would run their filters to know their state.
    """
    nested = [entry["path"] for entry in submodules(scratch)]
    others = ["--", ".", *(f":(exclude,literal){path}" for path in nested)] if nested else []
    if nested:
        scratch.run("update-index", "--remove", "-z", "--stdin", stdin=join_nul(nested))
    try:
        scratch.run("add", "-u", *others)
    except GitError:
        try:
            scratch.run("add", "-u", "--ignore-errors", *others)
        except GitError as error:
            left = scratch.paths("diff-files", "--name-only", "--ignore-submodules=all", "-z")
            if not left:
                raise
            return [Refused(path, f"git cannot read it: {error}") for path in left]
    return []


def changes_from(scratch: Repository, base: str) -> list[ChangedPath]:
    """Return how the index differs from a commit or tree."""
    parts = scratch.paths("diff-index", "--cached", "--raw", "--no-renames", "--no-abbrev", "-z", base)
    changes = []
    for facts, path in zip(parts[::2], parts[1::2], strict=True):
        old_mode, new_mode, old_id, new_id, _ = facts.removeprefix(":").split(" ")
        changes.append(ChangedPath(path, old_mode, old_id, new_mode, new_id))
    return changes


def refuse_secrets(scratch: Repository, changes: list[ChangedPath]) -> list[Refused]:
    """Set changes that would show a key or a token back to the base, and return them.

    Both sides of a change count, because a removed line stands in a patch as well.
    """
    contents = scratch.blobs([blob for change in changes for blob in change.blobs()])
    filtered = _filtered(scratch, [change.path for change in changes])
    refused: list[Refused] = []
    lines = []
    for change in changes:
        shown = (secret_content(contents[blob]) for blob in change.blobs())
        reason = secret_name(change.path) or filtered.get(change.path) or next(filter(None, shown), None)
        if reason is not None:
            refused.append(Refused(change.path, reason))
            # Mode 0 removes the path from the index.
            mode = "0" if change.old_mode == _NO_MODE else change.old_mode
            lines.append(f"{mode} {change.old_id}\t{change.path}")
    if lines:
        scratch.run("update-index", "-z", "--index-info", stdin=join_nul(lines))
    return refused


def new_sizes(scratch: Repository, changes: list[ChangedPath]) -> dict[str, int]:
    """Return the sizes in bytes of the changed files' new contents."""
    present = {c.path: c.new_id for c in changes if c.new_mode not in (_NO_MODE, _GITLINK)}
    contents = scratch.blobs(list(present.values()))
    return {path: len(contents[blob]) for path, blob in present.items()}


def patch_from(scratch: Repository, base: str) -> bytes:
    """Return the patch that makes the index's tree from ``base``, whatever the user's diff settings are."""
    options = ["--cached", "-p", "--binary", "--full-index", "--no-renames", "--no-color", "--no-ext-diff"]
    options += ["--no-textconv", "--src-prefix=a/", "--dst-prefix=b/", "--submodule=short"]
    options += ["--ignore-submodules=none", "--no-relative", "-U3"]
    return scratch.run("diff-index", *options, base)


def submodules(scratch: Repository) -> list[dict[str, str]]:
    """Return path and commit of every submodule and nested repository in the index."""
    found = []
    for entry in scratch.paths("ls-files", "--stage", "-z"):
        facts, path = entry.split("\t", 1)
        mode, commit, _ = facts.split(" ")
        if mode == _GITLINK:
            found.append({"path": path, "commit": commit})
    return found


def _relative_to_top(repository: Repository, folder: Path | None) -> Path | None:
    if folder is None:
        return None
    full, top = folder.resolve(), repository.top.resolve()
    return full.relative_to(top) if full != top and full.is_relative_to(top) else None


def _filtered(repository: Repository, paths: list[str]) -> dict[str, str]:
    """Return why files that pass through a filter program on their way into git are refused.

    Such a program may encrypt them, or drop what must not be seen.
    """
    programs = [name for name in filters(repository) if name not in _HARMLESS_FILTERS]
    if not programs or not paths:
        return {}
    output = repository.run("check-attr", "-z", "--stdin", "filter", stdin=join_nul(paths))
    parts = split_nul(output)
    found = zip(parts[::3], parts[2::3], strict=True)
    return {path: f"the filter '{name}' stands between it and git" for path, name in found if name in programs}


def _reason_against(repository: Repository, path: str) -> str | None:
    if path.endswith("/"):
        return "it is a repository of its own"
    full = repository.top / path
    if not full.is_symlink() and full.exists() and not os.access(full, os.R_OK):
        return "it cannot be read"
    return secret_name(path)


def _forget_promises(scratch: Repository) -> None:
    """Look again at files that the user told git to take for unchanged (assume-unchanged, skip-worktree)."""
    tagged = [(entry[0], entry[2:]) for entry in scratch.paths("ls-files", "-v", "-z")]
    here = [(tag, path) for tag, path in tagged if os.path.lexists(scratch.top / path)]
    assumed = [path for tag, path in here if tag.islower()]
    skipped = [path for tag, path in here if tag in "Ss"]
    for flag, paths in (("--no-assume-unchanged", assumed), ("--no-skip-worktree", skipped)):
        if paths:
            scratch.run("update-index", flag, "-z", "--stdin", stdin=join_nul(paths))


SOURCE_FORMAT = 1
PATCH_NAME = "source.patch"
RECORD_NAME = "git.json"

# The first three come with a patch that restores the tree; every other record has a note that says why not.
Status = Literal["ok", "no_commits", "no_repository", "installed", "patch_too_large", "no_git", "failed"]

_BIG_FILES_SHOWN = 20


@dataclass
class _Place:
    """A working tree, or a plain folder, whose files matter.

    Attributes:
        top: its top folder.
        repository: None where git knows none.
        why: why it is no repository.
        inside: the roots in it, as seen from the top.
        files: the files that matter; all when empty.
    """

    top: Path
    repository: Repository | None = None
    why: str = ""
    inside: list[str] = field(default_factory=lambda: ["."])
    files: list[str] = field(default_factory=list)


def entries(record: Any) -> list[Mapping[str, Any]]:
    """Return the record of each repository or folder in a ``git.json``, the main one first, without what is none."""
    others = record.get("others") if isinstance(record, Mapping) else None
    return [entry for entry in (record, *(others if isinstance(others, list) else ())) if isinstance(entry, Mapping)]


def snapshot_source(
    roots: Sequence[Path], folder: Path, *, runs_root: Path | None = None, max_patch_mb: float = 50.0
) -> dict[str, Any]:
    """Write ``git.json`` and the patches into ``folder`` and return the content of ``git.json``.

    Whatever git says, the run goes on: a source that cannot be kept is recorded with a status and a note.

    Args:
        roots: folders whose source matters, the package's own first, and single files; roots of one repository count
            once.
        folder: the run's ``source`` folder.
        runs_root: folder of the runs, whose untracked files are left out.
        max_patch_mb: largest patch, and largest sum of untracked files, in megabytes (10^6 bytes).

    Raises:
        SimulationFailure: the disk is full.
        RunDirectoryError: the folder cannot be written.
    """
    records: list[dict[str, Any]] = []
    waiting = _group(roots)
    while waiting:
        place = waiting.pop(0)
        record, patch = (
            (place, None) if isinstance(place, dict) else _snapshot(place, runs_root, int(max_patch_mb * 1e6))
        )
        if patch is not None:
            record["patch"] = PATCH_NAME if not records else f"source_{len(records) + 1}.patch"
            write_bytes(folder / record["patch"], patch)
        records.append(record)
        waiting += _checked_out(record, [*records, *map(_as_record, waiting)])
    if not records:
        records.append(new_record("no_repository", None, "no source folder was given"))
    content = {"format": SOURCE_FORMAT, **records[0], "others": records[1:]}
    write_json(folder / RECORD_NAME, content)
    return content


def _group(roots: Iterable[Path]) -> list[_Place | dict[str, Any]]:
    """Return each repository and each plain folder once with its roots inside it, or an installed root's record."""
    groups: dict[Path, _Place | dict[str, Any]] = {}
    for root in dict.fromkeys(Path(root).resolve() for root in roots):
        place = _place(root)
        if isinstance(place, dict):
            groups[root] = place
            continue
        known = groups.setdefault(place.top, place)
        if isinstance(known, _Place) and known is not place:
            known.inside += place.inside
            known.files = [*known.files, *place.files] if known.files and place.files else []
    return list(groups.values())


def _place(root: Path) -> _Place | dict[str, Any]:
    """Return where ``root`` is worked on, or a record that says why its files are not kept."""
    folder = root if root.is_dir() else root.parent
    try:
        top = os.fsdecode(run_git(folder, "rev-parse", "--show-toplevel")).removesuffix("\n")
    except GitError as error:
        if is_installed(root):
            return _installed(root)
        if isinstance(error, GitMissing):
            return new_record("no_git", root, "git is not installed, so the source is not kept")
        return _plain(root, str(error))
    repository = Repository(Path(top))
    if not root.is_relative_to(repository.top.resolve()):
        return _plain(root, f"the repository of '{root}' keeps its files in '{top}'")
    if is_installed(root, repository.top.resolve()):
        return _installed(root)
    if root != repository.top.resolve() and repository.maybe("check-ignore", "--", str(root)) is not None:
        return _plain(root, f"'{root}' is ignored by the repository around it")
    return _Place(repository.top, repository, inside=[root.relative_to(repository.top.resolve()).as_posix()])


def _plain(root: Path, why: str) -> _Place:
    """Return the place of a root that git does not look after."""
    if "not a git repository" in why:
        why = f"'{root}' is in no git repository"
    elif "dubious ownership" in why:
        why = f"git refuses the repository of '{root}', which belongs to another user"
    if root.is_dir():
        return _Place(root, why=why)
    return _Place(root.parent, why=why, inside=[root.name], files=[root.name])


def _installed(root: Path) -> dict[str, Any]:
    name = distribution_of(root)
    note = f"'{root}' is installed{f' ({name})' if name else ''}: its digest is kept, not its files"
    return {**new_record("installed", root, note), "distribution": name, "content_sha256": content_digest(root)}


def _checked_out(record: dict[str, Any], known: Sequence[dict[str, Any]]) -> list[_Place]:
    """Return the submodules of a record that are checked out and not among those known."""
    tops = {entry["root"] for entry in known}
    found = [Path(record["root"]) / entry["path"] for entry in record["submodules"]]
    return [_submodule(top, Path(record["root"])) for top in found if (top / ".git").exists() and str(top) not in tops]


def _submodule(top: Path, around: Path) -> _Place:
    """Return the place of a submodule, whose settings could lead to files, or a repository, that are none of it."""
    repository = Repository(top, {"GIT_DIR": str(top / ".git"), "GIT_WORK_TREE": str(top)})
    store = repository.maybe("rev-parse", "--absolute-git-dir")
    own = Repository(around).maybe("rev-parse", "--path-format=absolute", "--git-common-dir")
    if store is None or own is None or not any(Path(store).resolve().is_relative_to(p) for p in (top.resolve(), own)):
        return _Place(top, why=f"the repository of '{top}' is not its own, and not that of a submodule")
    return _Place(top, repository)


def _as_record(place: _Place | dict[str, Any]) -> dict[str, Any]:
    return place if isinstance(place, dict) else {"root": str(place.top)}


def _snapshot(place: _Place, runs_root: Path | None, cap: int) -> tuple[dict[str, Any], bytes | None]:
    """Return the record of a place and its patch, None where there is none."""
    record = new_record("ok" if place.repository else "no_repository", place.top, None)
    record["folders"] = place.inside
    if place.repository is None:
        return record, _capture_folder(place, record, runs_root, cap)
    try:
        _describe_commit(place.repository, record)
        return record, _capture(place.repository, record, runs_root, cap)
    except GitError as error:
        whole = _Place(place.top, why=f"git cannot read the repository of '{place.top}' ({error})")
        record = {**new_record("no_repository", place.top, None), "folders": place.inside}
        return record, _capture_folder(whole, record, runs_root, cap)


def _capture_folder(place: _Place, record: dict[str, Any], runs_root: Path | None, cap: int) -> bytes | None:
    """Do the same for a plain folder, by way of an empty repository elsewhere."""
    try:
        with borrowed_folder(place.top) as repository:
            record["base"] = repository.text("hash-object", "-t", "tree", os.devnull)
            patch = _capture(repository, record, runs_root, cap, place.files)
    except GitError as error:
        record.update(status="failed", note=f"{place.why}, and its files cannot be kept: {error}")
        return None
    if patch is not None:
        notes = [f"{place.why}; its files are kept as a patch from nothing", _left_out(record)]
        record["note"] = "; ".join(filter(None, notes))
    else:
        record["note"] = f"{place.why}; {record['note']}"
    return patch


def _describe_commit(repository: Repository, record: dict[str, Any]) -> None:
    commit = repository.maybe("rev-parse", "--verify", "--quiet", "HEAD")
    record["commit"] = commit
    record["base"] = commit or repository.text("hash-object", "-t", "tree", os.devnull)
    record["branch"] = repository.maybe("symbolic-ref", "-q", "--short", "HEAD")
    record["remote"] = _remote(repository, record["branch"])
    record["shallow"] = repository.text("rev-parse", "--is-shallow-repository") == "true"
    if commit is None:
        record["status"] = "no_commits"


def _capture(
    repository: Repository, record: dict[str, Any], runs_root: Path | None, cap: int, only: Sequence[str] = ()
) -> bytes | None:
    """Fill the record with the tree and return the patch; None when it would be too large."""
    untracked, refused = untracked_files(repository, runs_root)
    if only:
        untracked = [path for path in untracked if path in only]
        refused = [entry for entry in refused if entry.path in only]
    record["refused"] = [asdict(entry) for entry in refused]
    sizes = file_sizes(repository, untracked)
    if sum(sizes.values()) > cap:
        _refuse_patch(record, sizes, "the untracked files have", sum(sizes.values()), cap)
        return None
    with scratch_index(repository) as scratch:
        refused += add_everything(scratch, untracked)
        changes = changes_from(scratch, record["base"])
        refused += refuse_secrets(scratch, changes)
        left_out = {entry.path for entry in refused}
        record["refused"] = [asdict(entry) for entry in refused]
        record["untracked"] = [path for path in untracked if path not in left_out]
        kept = [change for change in changes if change.path not in left_out]
        record["changed"] = [change.path for change in kept]
        record["contents"] = {c.path: [state(c.old_mode, c.old_id), state(c.new_mode, c.new_id)] for c in kept}
        record["dirty"] = bool(changes or refused)
        record["submodules"] = submodules(scratch)
        record["tree"] = scratch.text("write-tree")
        patch = patch_from(scratch, record["base"])
        if len(patch) > cap:
            sizes = new_sizes(scratch, kept)
            _refuse_patch(record, sizes, "the patch has", len(patch), cap)
            return None
    record.update(patch_bytes=len(patch), patch_sha256=hashlib.sha256(patch).hexdigest(), note=_note(record))
    return patch


def new_record(status: Status, root: Path | None, note: str | None) -> dict[str, Any]:
    """Return a record with every key that there is, so that a reader never meets a missing one."""
    return {
        "status": status,
        "note": note,
        "root": None if root is None else str(root),
        "folders": [],
        "commit": None,
        "branch": None,
        "remote": None,
        "shallow": None,
        "base": None,
        "tree": None,
        "dirty": None,
        "untracked": [],
        "changed": [],
        "contents": None,
        "refused": [],
        "submodules": [],
        "big_files": [],
        "patch": None,
        "patch_bytes": None,
        "patch_sha256": None,
        "distribution": None,
        "content_sha256": None,
    }


def _remote(repository: Repository, branch: str | None) -> dict[str, str] | None:
    """Return name and address of the branch's own remote, else of origin, else of the first there is."""
    names = repository.text("remote").splitlines()
    tracked = repository.maybe("config", f"branch.{branch}.remote") if branch else None
    chosen = next((name for name in (tracked, "origin", *names) if name in names), None)
    if chosen is None:
        return None
    url = repository.maybe("config", f"remote.{chosen}.url") or ""
    return {"name": chosen, "url": without_credentials(url)}


def _refuse_patch(record: dict[str, Any], sizes: dict[str, int], what: str, size: int, cap: int) -> None:
    biggest = sorted(sizes.items(), key=lambda item: (-item[1], item[0]))[:_BIG_FILES_SHOWN]
    record.update(status="patch_too_large", dirty=True)
    record["big_files"] = [{"path": path, "bytes": count} for path, count in biggest]
    names = ", ".join(path for path, _ in biggest[:3])
    record["note"] = (
        f"{what} {size / 1e6:.1f} MB and run.max_patch_mb is {cap / 1e6:g}, so the changes are not kept; "
        f"commit or ignore the big files ({names}), or raise run.max_patch_mb"
    )


def _note(record: dict[str, Any]) -> str | None:
    notes = []
    if record["commit"] is None:
        notes.append("the repository has no commit; the patch makes the tree from nothing")
    notes.append(_left_out(record) or "")
    top = Path(record["root"])
    absent = [entry["path"] for entry in record["submodules"] if not (top / entry["path"] / ".git").exists()]
    if absent:
        notes.append("submodules that are not checked out: " + ", ".join(absent))
    return "; ".join(filter(None, notes)) or None


def _left_out(record: dict[str, Any]) -> str | None:
    names = ", ".join(entry["path"] for entry in record["refused"])
    return f"left out: {names}" if names else None
