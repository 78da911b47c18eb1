from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory

Git = Callable[..., str]


@pytest.fixture
def git(monkeypatch: pytest.MonkeyPatch) -> Git:
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
    monkeypatch.setenv("GIT_CONFIG_NOSYSTEM", "1")
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "someone")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "someone@example.org")

    def run(folder: Path, *arguments: str, stdin: bytes | None = None) -> str:
        done = subprocess.run(["git", *arguments], cwd=folder, input=stdin, capture_output=True, check=True)
        return done.stdout.decode().strip()

    return run


@pytest.fixture
def repository(tmp_path: Path, git: Git) -> Path:
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "-q", "-b", "main")
    (folder / ".gitignore").write_text("ignored/\n*.log\n")
    (folder / "package").mkdir()
    (folder / "package" / "code.py").write_text("x = 1\n")
    (folder / "package" / "data.bin").write_bytes(bytes(range(256)))
    (folder / "gone.txt").write_text("to be deleted\n")
    (folder / "script.sh").write_text("#!/bin/sh\n")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "first")
    return folder


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., RunDirectory]:
    def make(task: str = "walk", seed: int = 1, name: str | None = None, **keywords: Any) -> RunDirectory:
        now = keywords.pop("now", None)
        directory = RunDirectory.create(tmp_path / "runs", task, seed, name, now)
        Manifest.begin(directory.path, task=task, seed=seed, command=["wheelleg", "train"], threads={}, now=now)
        return directory

    return make
