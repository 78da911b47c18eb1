"""Run git commands that neither change a repository nor run a program named in its settings."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_TIMEOUT_S = 300

# Git's ids are 40 hexadecimal digits, or 64 in a repository of sha256.
OBJECT_ID = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")

# Variables that would send a command to another repository or index (set inside a git hook, for one).
_MISLEADING = (
    "GIT_DIR",
    "GIT_WORK_TREE",
    "GIT_INDEX_FILE",
    "GIT_COMMON_DIR",
    "GIT_OBJECT_DIRECTORY",
    "GIT_ALTERNATE_OBJECT_DIRECTORIES",
    "GIT_PREFIX",
    "GIT_NAMESPACE",
    "GIT_EXTERNAL_DIFF",
    "GIT_DIFF_OPTS",
    "GIT_LITERAL_PATHSPECS",
    "GIT_GLOB_PATHSPECS",
    "GIT_NOGLOB_PATHSPECS",
    "GIT_ICASE_PATHSPECS",
)

# Settings under which a command would write into the repository, or run a program of the user's.
_SETTINGS = {
    "core.fsmonitor": "false",
    "core.splitIndex": "false",
    "core.untrackedCache": "false",
    "core.hooksPath": os.devnull,
    "core.safecrlf": "false",
    "gc.auto": "0",
}

# No question, no download of what a partial clone lacks: the program for that stands in the repository's settings.
_ALONE = {"LC_ALL": "C", "GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0", "GIT_ALLOW_PROTOCOL": ""}

# What a folder that is in no repository holds beside its sources.
_LEFTOVERS = (
    "__pycache__/",
    "*.py[co]",
    ".ipynb_checkpoints/",
    ".mypy_cache/",
    ".pytest_cache/",
    ".ruff_cache/",
    ".nox/",
    ".tox/",
    "node_modules/",
    "*.egg-info/",
    ".DS_Store",
    "*.log",
    "nohup.out",
    "MUJOCO_LOG.TXT",
)


class GitError(Exception):
    """git is missing, or said no; the text is git's own."""


class GitMissing(GitError):
    """git is not installed."""


@dataclass(frozen=True)
class Repository:
    """A working tree, and the environment in which git is asked about it.

    Args:
        top: the working tree's top folder.
        environ: variables beside the process's own, such as another index.
        settings: git's settings for these commands alone, before those of the repository and the user.
    """

    top: Path
    environ: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)

    def run(self, *arguments: str, stdin: bytes = b"") -> bytes:
        """Run one git command in the working tree and return what it prints.

        Raises:
            GitError: git is missing, fails, or takes too long.
        """
        return run_git(self.top, *arguments, stdin=stdin, environ=self.environ, settings=self.settings)

    def text(self, *arguments: str) -> str:
        """Run one git command and return its output as text without the last newline."""
        return os.fsdecode(self.run(*arguments)).removesuffix("\n")

    def maybe(self, *arguments: str) -> str | None:
        """Run one git command whose failure means that there is no answer."""
        try:
            return self.text(*arguments) or None
        except GitError:
            return None

    def paths(self, *arguments: str) -> list[str]:
        """Run one git command that prints paths ended by NUL, and return them (odd names are kept)."""
        return split_nul(self.run(*arguments))

    def blobs(self, ids: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of blobs by id, asked in one command."""
        wanted = list(dict.fromkeys(ids))
        output = self.run("cat-file", "--batch", stdin="".join(f"{i}\n" for i in wanted).encode())
        found: dict[str, bytes] = {}
        at = 0
        for blob in wanted:
            # "<id> blob <size>\n<content>\n" each; "<id> missing\n" has no size (git-cat-file(1)).
            head, at = output[at : output.index(b"\n", at)], output.index(b"\n", at) + 1
            if head.endswith(b" missing"):
                raise GitError(f"object {blob} is missing")
            size = int(head.rsplit(b" ", 1)[1])
            found[blob] = output[at : at + size]
            at += size + 1
        return found


def run_git(
    folder: Path,
    *arguments: str,
    stdin: bytes = b"",
    environ: dict[str, str] | None = None,
    settings: dict[str, str] | None = None,
) -> bytes:
    """Run git in ``folder`` (see ``Repository.run``)."""
    kept = {k: v for k, v in os.environ.items() if k not in _MISLEADING} | _ALONE
    kept |= _in_force({**_SETTINGS, **(settings or {})}, kept) | (environ or {})
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            input=stdin,
            capture_output=True,
            env=kept,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except FileNotFoundError:
        if folder.is_dir():
            raise GitMissing("git is not installed") from None
        raise GitError(f"there is no folder '{folder}'") from None
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        raise GitError(f"git did not answer: {error}") from error
    if done.returncode != 0:
        raise GitError(_complaint(done.stderr) or f"git {arguments[0]} ended with {done.returncode}")
    return done.stdout


def _in_force(settings: dict[str, str], environ: dict[str, str]) -> dict[str, str]:
    """Return the variables that put settings before all others; ``-c`` takes no name with ``=`` in it."""
    first = int(environ.get("GIT_CONFIG_COUNT") or 0)
    found = {"GIT_CONFIG_COUNT": str(first + len(settings))}
    for number, (key, value) in enumerate(settings.items(), first):
        found |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    return found


def split_nul(output: bytes) -> list[str]:
    """Return the NUL-ended names in git's output; bytes that are no UTF-8 survive as surrogates."""
    return [os.fsdecode(part) for part in output.split(b"\0") if part]


def join_nul(names: Iterable[str]) -> bytes:
    """Return names as git's NUL-ended input."""
    return b"".join(os.fsencode(name) + b"\0" for name in names)


@contextmanager
def scratch_index(repository: Repository) -> Iterator[Repository]:
    """Yield the same working tree with a copy of its index and an object store of its own.

    Whatever is added there, the user's index and the contents of the object store stay as they are. Both
    copies are gone afterwards. No filter program runs: what is added is what stands on the disk.
    """
    index = repository.top / repository.text("rev-parse", "--git-path", "index")
    objects = repository.top / repository.text("rev-parse", "--git-path", "objects")
    with tempfile.TemporaryDirectory(prefix="wheelleg-git-") as folder:
        scratch = Path(folder)
        (scratch / "objects" / "info").mkdir(parents=True)
        alternates = os.fsencode(objects.resolve()) + b"\n"
        (scratch / "objects" / "info" / "alternates").write_bytes(alternates)
        if index.is_file():
            # With its times: git takes an entry for unchanged by comparing them with the index's own.
            shutil.copy2(index, scratch / "index")
        environ = {"GIT_INDEX_FILE": str(scratch / "index"), "GIT_OBJECT_DIRECTORY": str(scratch / "objects")}
        settings = {**repository.settings, **_without_filters(filters(repository))}
        yield Repository(repository.top, {**repository.environ, **environ}, settings)


def filters(repository: Repository) -> list[str]:
    """Return the names of the filter programs that git would run on files (``filter.<name>.clean``)."""
    output = repository.maybe("config", "--name-only", "--get-regexp", r"^filter\..*\.(clean|process)$") or ""
    return sorted({line.removeprefix("filter.").rpartition(".")[0] for line in output.splitlines()})


def _without_filters(names: Iterable[str]) -> dict[str, str]:
    off = {"clean": "", "smudge": "", "process": "", "required": "false"}
    return {f"filter.{name}.{key}": value for name in names for key, value in off.items()}


@contextmanager
def borrowed_folder(folder: Path) -> Iterator[Repository]:
    """Yield a plain folder as the working tree of an empty repository that stands elsewhere and is gone afterwards.

    The folder itself is only read. Its own ``.gitignore`` files hold; what tools leave behind is ignored as well.
    """
    with tempfile.TemporaryDirectory(prefix="wheelleg-git-") as scratch:
        store = Path(scratch) / "git"
        run_git(Path(scratch), "init", "--quiet", "--bare", "--template=", str(store))
        (store / "info").mkdir(exist_ok=True)
        (store / "info" / "exclude").write_text("\n".join(_LEFTOVERS) + "\n", encoding="utf-8")
        yield Repository(folder, {"GIT_DIR": str(store), "GIT_WORK_TREE": str(folder)}, {"core.bare": "false"})


def _complaint(stderr: bytes) -> str:
    lines = stderr.decode("utf-8", "replace").strip().splitlines()
    fatal = [line for line in lines if line.startswith(("fatal:", "error:"))]
    return (fatal or lines or [""])[0].removeprefix("fatal: ").removeprefix("error: ")
