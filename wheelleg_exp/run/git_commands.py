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
from urllib.parse import urlsplit, urlunsplit

_TIMEOUT_S = 300

# Git's ids are 40 hexadecimal digits, or 64 in a repository of sha256.
OBJECT_ID = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?")

# Variables that redirect a command to another repository or index; a git hook sets some of them.
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

# With other values of these settings, a command writes into the repository or runs a user-defined program.
_SETTINGS = {
    "core.fsmonitor": "false",
    "core.splitIndex": "false",
    "core.untrackedCache": "false",
    "core.hooksPath": os.devnull,
    "core.safecrlf": "false",
    "gc.auto": "0",
}

# No prompt, and no download of objects that a partial clone lacks: the repository's settings name the program for it.
_ALONE = {"LC_ALL": "C", "GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0", "GIT_ALLOW_PROTOCOL": ""}


class GitError(Exception):
    """A git command failed; the message is git's own."""


class GitMissing(GitError):
    """git is not installed."""


@dataclass(frozen=True)
class Repository:
    """A working tree, and the environment of the git commands that run in it.

    Args:
        top: the working tree's top folder.
        environ: variables in addition to the process's own, such as another index.
        settings: git settings that override those of the repository and of the user.
    """

    top: Path
    environ: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)

    def run(self, *arguments: str, stdin: bytes = b"") -> bytes:
        """Run one git command in the working tree and return its output.

        Raises:
            GitError: git is missing or fails, or the command takes too long.
        """
        return run_git(self.top, *arguments, stdin=stdin, environ=self.environ, settings=self.settings)

    def text(self, *arguments: str) -> str:
        """Run one git command and return its output as text without the last newline."""
        return os.fsdecode(self.run(*arguments)).removesuffix("\n")

    def maybe(self, *arguments: str) -> str | None:
        """Run one git command and return its output as text; None when the command fails or prints nothing."""
        try:
            return self.text(*arguments) or None
        except GitError:
            return None

    def paths(self, *arguments: str) -> list[str]:
        """Run one git command that prints NUL-ended paths, and return the paths."""
        return split_nul(self.run(*arguments))


def run_git(
    folder: Path,
    *arguments: str,
    stdin: bytes = b"",
    environ: dict[str, str] | None = None,
    settings: dict[str, str] | None = None,
) -> bytes:
    """Run git in ``folder`` (see ``Repository.run``)."""
    kept = {k: v for k, v in os.environ.items() if k not in _MISLEADING} | _ALONE
    kept |= _override_variables({**_SETTINGS, **(settings or {})}, kept) | (environ or {})
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
        raise GitError(f"the folder '{folder}' does not exist") from None
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        raise GitError(f"git failed: {error}") from error
    if done.returncode != 0:
        raise GitError(_complaint(done.stderr) or f"git {arguments[0]} exited with status {done.returncode}")
    return done.stdout


def _override_variables(settings: dict[str, str], environ: dict[str, str]) -> dict[str, str]:
    """Return the variables that override git settings; ``git -c`` would not accept a name that contains ``=``."""
    first = int(environ.get("GIT_CONFIG_COUNT") or 0)
    found = {"GIT_CONFIG_COUNT": str(first + len(settings))}
    for number, (key, value) in enumerate(settings.items(), first):
        found |= {f"GIT_CONFIG_KEY_{number}": key, f"GIT_CONFIG_VALUE_{number}": value}
    return found


def split_nul(output: bytes) -> list[str]:
    """Return the NUL-ended names in git's output; bytes that are not UTF-8 become surrogates."""
    return [os.fsdecode(part) for part in output.split(b"\0") if part]


def join_nul(names: Iterable[str]) -> bytes:
    """Return names as NUL-ended input of git."""
    return b"".join(os.fsencode(name) + b"\0" for name in names)


@contextmanager
def scratch_index(repository: Repository) -> Iterator[Repository]:
    """Yield the same working tree with a temporary copy of its index and a temporary object store.

    The user's index and object store do not change. No filter program runs: git adds the bytes on the disk.
    """
    index = repository.top / repository.text("rev-parse", "--git-path", "index")
    objects = repository.top / repository.text("rev-parse", "--git-path", "objects")
    with tempfile.TemporaryDirectory(prefix="wheelleg-git-") as folder:
        scratch = Path(folder)
        (scratch / "objects" / "info").mkdir(parents=True)
        alternates = os.fsencode(objects.resolve()) + b"\n"
        (scratch / "objects" / "info" / "alternates").write_bytes(alternates)
        if index.is_file():
            # copy2 preserves the times: git compares them with the times in the index to find changed files.
            shutil.copy2(index, scratch / "index")
        environ = {"GIT_INDEX_FILE": str(scratch / "index"), "GIT_OBJECT_DIRECTORY": str(scratch / "objects")}
        settings = {**repository.settings, **_without_filters(filters(repository))}
        yield Repository(repository.top, {**repository.environ, **environ}, settings)


def filters(repository: Repository) -> list[str]:
    """Return the names of the filters that have a program for files on their way into git (``filter.<name>.clean``)."""
    output = repository.maybe("config", "--name-only", "--get-regexp", r"^filter\..*\.(clean|process)$") or ""
    return sorted({line.removeprefix("filter.").rpartition(".")[0] for line in output.splitlines()})


def _without_filters(names: Iterable[str]) -> dict[str, str]:
    off = {"clean": "", "smudge": "", "process": "", "required": "false"}
    return {f"filter.{name}.{key}": value for name in names for key, value in off.items()}


def without_credentials(url: str) -> str:
    """Return a URL without user, password, query and fragment; the user of ``ssh`` stays.

    The short form ``git@host:path`` and local paths have no credentials and are returned unchanged.
    """
    if "://" not in url:
        return url
    try:
        parts = urlsplit(url)
    except ValueError:
        return "(a URL that cannot be read)"
    userinfo, at, host = parts.netloc.rpartition("@")
    user = userinfo.split(":", 1)[0] if at and parts.scheme in ("ssh", "git+ssh") else ""
    return urlunsplit((parts.scheme, f"{user}@{host}" if user else host, parts.path, "", ""))


def _complaint(stderr: bytes) -> str:
    lines = stderr.decode("utf-8", "replace").strip().splitlines()
    fatal = [line for line in lines if line.startswith(("fatal:", "error:"))]
    return (fatal or lines or [""])[0].removeprefix("fatal: ").removeprefix("error: ")
