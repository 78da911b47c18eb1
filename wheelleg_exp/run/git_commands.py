"""Run git commands that neither change the repository nor run programs named in the git settings."""

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
from urllib.parse import urlsplit, urlunsplit

_TIMEOUT_S = 300

# A git object id has 40 hexadecimal digits, or 64 in a repository that uses sha256.
OBJECT_ID = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")

# Git hooks set environment variables that redirect a git command to a different repository.
_MISLEADING = (
    *("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR", "GIT_OBJECT_DIRECTORY", "GIT_PREFIX"),
    *("GIT_ALTERNATE_OBJECT_DIRECTORIES", "GIT_NAMESPACE", "GIT_EXTERNAL_DIFF", "GIT_DIFF_OPTS"),
    *("GIT_LITERAL_PATHSPECS", "GIT_GLOB_PATHSPECS", "GIT_NOGLOB_PATHSPECS", "GIT_ICASE_PATHSPECS"),
)

# Git settings that prevent git commands from writing into the repository and from running user-defined programs.
_SETTINGS = dict.fromkeys(("core.fsmonitor", "core.splitIndex", "core.untrackedCache", "core.safecrlf"), "false")
_SETTINGS |= {"core.hooksPath": os.devnull, "gc.auto": "0"}

# Git must neither prompt for input nor download the objects that a partial clone lacks.
# To download objects, git could run an untrusted program that is named in the repository's settings.
_ALONE = {"LC_ALL": "C", "GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0", "GIT_ALLOW_PROTOCOL": ""}


class GitError(Exception):
    """A git command failed; the message of this exception is git's error message."""


class GitMissing(GitError):
    """git is not installed."""


@dataclass(frozen=True)
class Repository:
    """A git working tree: its top folder, and the environment of the git commands that run in this folder."""

    top: Path
    environ: dict[str, str] = field(default_factory=dict)  # ``environ`` has environment variables for each git command.
    settings: dict[str, str] = field(default_factory=dict)  # ``settings`` override the user's git config.

    def run(self, *arguments: str, stdin: bytes = b"") -> bytes:
        """Run one git command in the working tree and return the command's output; raise GitError for a failure."""
        return run_git(self.top, *arguments, stdin=stdin, environ=self.environ, settings=self.settings)

    def text(self, *arguments: str) -> str:
        return os.fsdecode(self.run(*arguments)).removesuffix("\n")

    def maybe(self, *arguments: str) -> str | None:
        """Run one git command and return the command's output as text; None if the command fails or prints nothing."""
        try:
            return self.text(*arguments) or None
        except GitError:
            return None

    def paths(self, *arguments: str) -> list[str]:
        """Run one git command that prints a NUL byte after each path, and return the paths."""
        return split_nul(self.run(*arguments))


def run_git(
    folder: Path,
    *arguments: str,
    stdin: bytes = b"",
    environ: dict[str, str] | None = None,
    settings: dict[str, str] | None = None,
) -> bytes:
    """Run one git command in ``folder`` and return the command's output; raise GitError if the command fails."""
    kept = {k: v for k, v in os.environ.items() if k not in _MISLEADING} | _ALONE
    # Set git settings by environment variables, because ``git -c`` does not accept a name that contains ``=``.
    first = int(kept.get("GIT_CONFIG_COUNT") or 0)
    overridden = {**_SETTINGS, **(settings or {})}
    kept["GIT_CONFIG_COUNT"] = str(first + len(overridden))
    for number, (key, value) in enumerate(overridden.items(), first):
        kept |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    kept |= environ or {}
    try:
        done = subprocess.run(
            ["git", *arguments], input=stdin, capture_output=True, cwd=folder, env=kept, timeout=_TIMEOUT_S, check=False
        )
    except FileNotFoundError:
        if folder.is_dir():
            raise GitMissing("git is not installed") from None
        raise GitError(f"the folder '{folder}' for the git command does not exist") from None
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        raise GitError(f"git failed: {error}") from error
    if done.returncode != 0:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        fatal = [line for line in lines if line.startswith(("fatal:", "error:"))]
        complaint = (fatal or lines or [""])[0].removeprefix("fatal: ").removeprefix("error: ")
        raise GitError(complaint or f"git {arguments[0]} exited with status {done.returncode}")
    return done.stdout


def split_nul(output: bytes) -> list[str]:
    """Return the NUL-terminated names in the output of git; bytes that are not UTF-8 become surrogate characters."""
    return [os.fsdecode(part) for part in output.split(b"\0") if part]


def join_nul(names: Iterable[str]) -> bytes:
    """Join file names to bytes for git's standard input, with a NUL byte after each name."""
    return b"".join(os.fsencode(name) + b"\0" for name in names)


@contextmanager
def scratch_index(repository: Repository) -> Iterator[Repository]:
    """Yield a ``Repository`` of the same working tree whose git commands use a temporary index and object store.

    The git commands of the yielded ``Repository`` run no filters, and do not change the user's index or object store.
    """
    index = repository.top / repository.text("rev-parse", "--git-path", "index")
    objects = repository.top / repository.text("rev-parse", "--git-path", "objects")
    with tempfile.TemporaryDirectory(prefix="wheelleg-git-") as folder:
        scratch = Path(folder)
        (scratch / "objects" / "info").mkdir(parents=True)
        (scratch / "objects" / "info" / "alternates").write_bytes(os.fsencode(objects.resolve()) + b"\n")
        if index.is_file():
            # Preserve the modification time of git's index file, because git uses this time to find changed files.
            shutil.copy2(index, scratch / "index")
        environ = {"GIT_INDEX_FILE": str(scratch / "index"), "GIT_OBJECT_DIRECTORY": str(scratch / "objects")}
        off = {"clean": "", "smudge": "", "process": "", "required": "false"}
        no_filters = {f"filter.{name}.{key}": value for name in filters(repository) for key, value in off.items()}
        yield Repository(repository.top, {**repository.environ, **environ}, {**repository.settings, **no_filters})


def filters(repository: Repository) -> list[str]:
    """Return the names of the git filters that run a program when git adds a file."""
    output = repository.maybe("config", "--name-only", "--get-regexp", r"^filter\..*\.(clean|process)$") or ""
    return sorted({line.removeprefix("filter.").rpartition(".")[0] for line in output.splitlines()})


def without_credentials(url: str) -> str:
    """Return a URL without password, query, and fragment; keep the user name only for ``ssh`` URLs."""
    if "://" not in url:
        return url
    try:
        parts = urlsplit(url)
    except ValueError:
        return "(a URL that cannot be read)"
    userinfo, at, host = parts.netloc.rpartition("@")
    user = userinfo.split(":", 1)[0] if at and parts.scheme in ("ssh", "git+ssh") else ""
    return urlunsplit((parts.scheme, f"{user}@{host}" if user else host, parts.path, "", ""))
