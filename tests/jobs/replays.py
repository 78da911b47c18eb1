"""Runs of a small clone of this project, for replays: a checkout with changes, trained in processes of its own."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE_S

import wheelleg_exp
from jobs.small import SMALL
from wheelleg_exp.paths import assets_dir, configs_dir
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import text_with_digest

ITERATIONS = 3

# Uncommitted files of a user: a task with a user-defined term, in this project's folders.
LEANING = """# @package _global_
defaults:
  - stand
  - _self_
task: {name: leaning}
env: {rewards: {leaning: {_target_: wheelleg_exp.mdp.leaning.leaning, weight: 1.0}}}
"""
TERM = """import torch

from wheelleg_exp.managers import Env


def leaning(env: Env) -> torch.Tensor:
    \"\"\"Some reward that depends on what happens.\"\"\"
    return 1.25 * env.scene["robot"].data.root_lin_vel_b[:, 0]
"""


def git(folder: Path, *arguments: str, stdin: bytes = b"") -> str:
    environ = {**os.environ, "GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_NOSYSTEM": "1"}
    for role in ("AUTHOR", "COMMITTER"):
        environ |= {f"GIT_{role}_NAME": "someone", f"GIT_{role}_EMAIL": "someone@example.org"}
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=folder, input=stdin, capture_output=True, check=True, env=environ)
    return done.stdout.decode().strip()


def make_checkout(folder: Path) -> Path:
    """Commit the current working tree of this project in a new repository."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    left_out = shutil.ignore_patterns("__pycache__", "*.pyc", "configs", "assets")
    package = Path(wheelleg_exp.__file__).parent
    shutil.copytree(package, folder / "wheelleg_exp", ignore=left_out)
    for source in (configs_dir(), assets_dir()):  # No replay needs the stock policies, which are large.
        shutil.copytree(source, folder / source.name, ignore=shutil.ignore_patterns("__pycache__", "policies"))
    (folder / ".gitignore").write_text("__pycache__/\nruns/\n")
    commit(folder)
    return folder


def commit(folder: Path) -> None:
    """Commit all files of a folder; initialize a repository if the folder has none."""
    git(folder, "init", "-q", "-b", "main")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "all of it")


def train(checkout: Path, *overrides: str, root: Path, options: tuple[str, ...] = (), path: Path | None = None) -> Path:
    """Train with a checkout's code in a child process, and return the run directory.

    ``path`` is one more folder of modules.
    """
    # With -R, the process is not a fork: the hashes of a replay differ from those of the run.
    command = [sys.executable, "-RP", "-m", "wheelleg_exp.cli.main", "train", *SMALL, *overrides, f"run.root={root}"]
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, filter(None, (checkout, path))))}
    done = subprocess.run(
        [*command, *options], cwd=checkout, env=environ, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    (path,) = root.glob("*/*/manifest.json")
    return path.parent


def digests(folder: Path) -> dict[str, str]:
    """Return the sha256 of every file below a folder, except locks and bytecode."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts and not path.name.endswith(".lock")
    }


def change_manifest(run: Path, **changes: object) -> None:
    """Change a manifest as if the run had written it so: with the digests and the seal of what is there now."""
    path = run / "manifest.json"
    data = json.loads(path.read_text()) | changes
    data["files"] = {name: record for name, record in inventory(run).items() if name in data["files"]}
    path.write_text(text_with_digest(data))
