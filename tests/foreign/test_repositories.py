import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from wheelleg_exp.run.git_commands import run_git
from wheelleg_exp.run.source_snapshot import snapshot_source

pytestmark = pytest.mark.train

HOOKS = ("post-index-change", "pre-commit", "reference-transaction", "post-checkout")


@dataclass
class Repositories:
    root: Path
    outer: Path
    inner: Path

    @property
    def canary(self) -> Path:
        return self.root / "ran"

    @property
    def touch(self) -> str:
        return f"touch {self.canary}"

    def git(self, folder: Path, *words: str) -> str:
        return subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()

    def set(self, key: str, value: str) -> None:
        self.git(self.inner, "config", key, value)

    def commit(self, folder: Path) -> None:
        self.git(folder, "init", "-q")
        self.git(folder, "add", "-A")
        self.git(folder, "commit", "-qm", "first")


@pytest.fixture(params=["nested", "submodule", "own"])
def repositories(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Repositories:
    for name, value in {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_NOSYSTEM": "1"}.items():
        monkeypatch.setenv(name, value)
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "someone")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "someone@example.org")
    outer, library = tmp_path / "outer", tmp_path / "library"
    for folder in (outer, library):
        folder.mkdir()
        (folder / "f").write_text("a\n" * 50)
    made = Repositories(tmp_path, outer, outer / "inner")
    made.commit(outer)
    made.commit(library)
    if request.param == "own":
        made.inner = outer
    elif request.param == "submodule":
        made.git(outer, "-c", "protocol.file.allow=always", "submodule", "--quiet", "add", str(library), "inner")
    else:
        shutil.copytree(library, made.inner)
        made.git(outer, "add", "inner")
    if request.param != "own":
        made.git(outer, "commit", "-qm", "second")
    (made.inner / "f").write_text("a\n" * 49 + "b\n")  # The file size is unchanged, so that git must read the file.
    (made.inner / "new.txt").write_text("new")
    return made


def fsmonitor(made: Repositories) -> None:
    made.set("core.fsmonitor", f"{made.touch}; echo")


def hooks(made: Repositories) -> None:
    folder = made.root / "hooks"
    folder.mkdir()
    for name in HOOKS:
        (folder / name).write_text(f"#!/bin/sh\n{made.touch}\n")
        (folder / name).chmod(0o755)
    made.set("core.hooksPath", str(folder))


def clean(made: Repositories, name: str = "x", kind: str = "clean") -> None:
    made.set(f"filter.{name}.{kind}", f"{made.touch}; cat")
    made.set(f"filter.{name}.required", "true")
    (made.inner / ".gitattributes").write_text(f"* filter={name}\n")


def asked_for_all_the_same(made: Repositories) -> None:
    clean(made)
    made.git(made.outer, "config", "submodule.inner.ignore", "none")
    made.git(made.outer, "config", "diff.ignoreSubmodules", "none")
    (made.outer / ".gitmodules").write_text('[submodule "inner"]\n path = inner\n url = x\n ignore = none\n')


def diffs(made: Repositories) -> None:
    made.set("diff.external", f"{made.touch}; true")
    made.set("diff.x.command", f"{made.touch}; true")
    made.set("diff.x.textconv", f"{made.touch}; cat")
    (made.inner / ".gitattributes").write_text("* diff=x\n")


def download(made: Repositories, url: str = "ssh://nowhere.invalid/x") -> None:
    settings = {"core.repositoryformatversion": "1", "extensions.partialClone": "evil", "remote.evil.promisor": "true"}
    settings |= {"remote.evil.url": url, "core.sshCommand": made.touch, "protocol.ext.allow": "always"}
    blob = made.git(made.inner, "rev-parse", "HEAD:f")
    objects = made.inner / made.git(made.inner, "rev-parse", "--git-path", "objects")
    (objects / blob[:2] / blob[2:]).unlink()
    for key, value in settings.items():
        made.set(key, value)


PROGRAMS: dict[str, Callable[[Repositories], None]] = {
    "fsmonitor": fsmonitor,
    "hooks": hooks,
    "clean": clean,
    "process": lambda made: clean(made, kind="process"),
    "an odd name": lambda made: clean(made, "a=b"),
    "asked for all the same": asked_for_all_the_same,
    "diffs": diffs,
    "ssh": download,
    "ext": lambda made: download(made, f"ext::touch {made.canary}"),
}


@pytest.mark.parametrize("plant", PROGRAMS.values(), ids=PROGRAMS)
def test_no_program_of_a_repository_runs(repositories, plant):
    plant(repositories)
    assert not repositories.canary.exists()
    (record,) = snapshot_source([repositories.outer], repositories.root / "source")
    assert not repositories.canary.exists()
    assert record.root == str(repositories.outer)


def borrowed(made: Repositories, private: Path) -> None:
    made.commit(private)
    store = made.inner / ".git"
    shutil.rmtree(store) if store.is_dir() else store.unlink()
    store.write_text(f"gitdir: {private}/.git\n")


@pytest.mark.parametrize("plant", [lambda made, private: made.set("core.worktree", str(private)), borrowed])
def test_a_snapshot_contains_nothing_of_another_folder(repositories, plant):
    private = repositories.root / "private"
    private.mkdir()
    (private / "diary.txt").write_text("precious\n")
    if plant is borrowed and repositories.inner == repositories.outer:
        pytest.skip("the working directory's repository is the user's own")
    plant(repositories, private)
    source = repositories.root / "source"
    snapshot_source([repositories.outer], source)
    texts = {path.name: path.read_bytes() for path in source.iterdir()}
    assert [name for name, text in texts.items() if b"precious" in text or b"diary" in text] == []


def test_settings_of_the_environment_apply_together_with_ours(repositories, monkeypatch):
    for name, value in {"COUNT": "1", "KEY_0": "user.name", "VALUE_0": "somebody"}.items():
        monkeypatch.setenv(f"GIT_CONFIG_{name}", value)
    assert run_git(repositories.outer, "config", "user.name") == b"somebody\n"
    assert run_git(repositories.outer, "config", "core.fsmonitor") == b"false\n"
