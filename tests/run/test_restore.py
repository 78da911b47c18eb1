from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.source_restore import find_origin, load_source, restore_source
from wheelleg_exp.run.source_snapshot import snapshot_source


def snapshot(root: Path, run: Path) -> dict:
    snapshot_source([root], run / "source")
    return json.loads((run / "source" / "git.json").read_text())


def change_record(run: Path, **changes) -> None:
    path = run / "source" / "git.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def forge(run: Path, patch: bytes, **changes) -> None:
    (run / "source" / "source.patch").write_bytes(patch)
    sha = hashlib.sha256(patch).hexdigest()
    change_record(run, patch="source.patch", patch_bytes=len(patch), patch_sha256=sha, **changes)


def new_file(path: str, text: str = "evil", mode: str = "100644") -> bytes:
    head = f"diff --git a/{path} b/{path}\nnew file mode {mode}\n--- /dev/null\n+++ b/{path}\n"
    return f"{head} -0,0 +1 \n+{text}\n\\ No newline at end of file\n".encode()


def files_outside(folder: Path, *known: Path) -> set[str]:
    found = [path for path in folder.rglob("*") if not any(path == k or path.is_relative_to(k) for k in known)]
    return {path.relative_to(folder).as_posix() for path in found}


@pytest.mark.parametrize("kind", ["full", "shallow", "bare", "worktree"])
def test_the_clone_may_be_of_any_kind(repository, git, tmp_path, kind):
    git(repository, "commit", "-q", "--allow-empty", "-m", "second")
    (repository / "new.yaml").write_text("a: 1\n")
    record = snapshot(repository, tmp_path / "run")
    clone = tmp_path / "clone"
    if kind == "worktree":
        git(repository, "worktree", "add", "-q", "--detach", str(clone))
    else:
        options = {"full": [], "shallow": ["--depth", "1"], "bare": ["--bare"]}[kind]
        git(tmp_path, "clone", "-q", *options, f"file://{repository}", str(clone))
    if kind in ("full", "shallow"):
        shutil.rmtree(repository)
    assert restore_source(tmp_path / "run", tmp_path / "again", clone) == record["tree"]
    assert git(tmp_path / "again", "status", "--porcelain") == "A  new.yaml"
    assert (tmp_path / "again" / "new.yaml").read_text() == "a: 1\n"
    assert kind == "bare" or git(clone, "status", "--porcelain") == ""


def test_a_commit_is_found_without_a_branch_and_a_missing_one_is_reported_with_a_remedy(repository, git, tmp_path):
    git(repository, "remote", "add", "origin", "https://user:word@example.org/robots.git")
    record = snapshot(repository, tmp_path / "run")
    git(repository, "commit", "-q", "--amend", "-m", "another")
    assert git(repository, "rev-parse", "HEAD") != record["commit"]
    assert restore_source(tmp_path / "run", tmp_path / "again") == record["tree"]
    nowhere, other = tmp_path / "nowhere", tmp_path / "other"
    git(tmp_path, "init", "-q", str(other))
    assert find_origin(*load_source(tmp_path / "run"), [nowhere, other, repository]) == repository
    with pytest.raises(RunDirectoryError) as caught:
        find_origin(*load_source(tmp_path / "run"), [nowhere, other])
    words = [f"{other}: does not contain it", f"the folder '{nowhere}'", "--repository"]
    words += [f"git fetch https://example.org/robots.git {record['commit']}"]
    assert [word for word in words if word not in str(caught.value)] == []


def test_a_tree_without_a_commit_needs_no_repository(tmp_path, git):
    unborn = tmp_path / "unborn"
    git(tmp_path, "init", "-q", str(unborn))
    (unborn / "robot.yaml").write_text("a: 1\n")
    record = snapshot(unborn, tmp_path / "run")
    shutil.rmtree(unborn)
    assert record["commit"] is None
    assert find_origin(*load_source(tmp_path / "run"), []) is None
    assert restore_source(tmp_path / "run", tmp_path / "again") == record["tree"]
    assert (tmp_path / "again" / "robot.yaml").read_text() == "a: 1\n"


def test_this_users_settings_change_no_byte(repository, git, tmp_path, monkeypatch):
    (repository / ".gitattributes").write_text("*.big filter=lfs\n")
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"
    (repository / "mesh.big").write_text(pointer)
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "with a pointer")
    (repository / "package" / "code.py").write_text("x = 2\n")
    record = snapshot(repository, tmp_path / "run")
    hooks = tmp_path / "template" / "hooks"
    hooks.mkdir(parents=True)
    for name in ("post-checkout", "post-index-change", "reference-transaction"):
        (hooks / name).write_text(f"#!/bin/sh\ntouch {tmp_path}/hooked\n")
        (hooks / name).chmod(0o755)
    (tmp_path / "gitconfig").write_text(
        "[core]\nautocrlf = true\n[apply]\nwhitespace = fix\n[init]\n"
        f'templateDir = {tmp_path}/template\n[filter "lfs"]\nsmudge = false\nprocess = false\nrequired = true\n'
    )
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", str(tmp_path / "gitconfig"))
    assert restore_source(tmp_path / "run", tmp_path / "again") == record["tree"]
    assert (tmp_path / "again" / "package" / "code.py").read_bytes() == b"x = 2\n"
    assert (tmp_path / "again" / "mesh.big").read_text() == pointer
    assert not (tmp_path / "hooked").exists()
    assert not (tmp_path / "again" / ".git" / "hooks").exists()


ESCAPES = {
    "above": new_file("../evil"),
    "absolute": new_file("/tmp/wheelleg_evil"),
    "hook": new_file(".git/hooks/post-checkout", "#!/bin/sh", "100755"),
    "git_config": new_file(".GIT/config"),
    "through_a_link": new_file("link", "../outside", "120000") + new_file("link/evil"),
    "through_a_committed_link": new_file("committed/evil"),
}


@pytest.mark.parametrize("name", ESCAPES)
def test_a_patch_writes_nothing_outside_its_tree(repository, git, tmp_path, name):
    outside = tmp_path / "outside"
    outside.mkdir()
    (repository / "committed").symlink_to(outside)
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "a link")
    run, place = tmp_path / "run", tmp_path / "place" / "deep"
    snapshot(repository, run)
    forge(run, ESCAPES[name])
    before = files_outside(tmp_path, place)
    with pytest.raises(RunDirectoryError):
        restore_source(run, place / "again")
    assert files_outside(tmp_path, place) - {"place"} == before
    assert not list(place.glob("*"))
    assert not Path("/tmp/wheelleg_evil").exists()


def test_a_link_to_elsewhere_is_a_link_and_its_target_survives_the_removal(repository, git, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("1")
    (repository / "link").symlink_to(outside)
    snapshot(repository, tmp_path / "run")
    restore_source(tmp_path / "run", tmp_path / "again")
    assert (tmp_path / "again" / "link").is_symlink()
    shutil.rmtree(tmp_path / "again")
    assert (outside / "precious").exists()


def test_a_patch_that_differs_from_the_recorded_patch_or_tree_is_refused(repository, tmp_path, monkeypatch):
    (repository / "package" / "code.py").write_text("x = 2\n")
    snapshot(repository, tmp_path / "run")
    path = tmp_path / "run" / "source" / "source.patch"
    forged = path.read_bytes().replace(b"x = 2", b"x = 3")
    path.write_bytes(forged)
    with monkeypatch.context() as patch:
        patch.setattr("wheelleg_exp.run.source_restore.run_git", pytest.fail)  # Git must not read the patch.
        with pytest.raises(RunDirectoryError, match="changed since the run recorded it"):
            restore_source(tmp_path / "run", tmp_path / "again")
    forge(tmp_path / "run", forged)
    with pytest.raises(RunDirectoryError, match="the restored source has the tree"):
        restore_source(tmp_path / "run", tmp_path / "again")
    assert not (tmp_path / "again").exists()


MALICIOUS = [{"commit": "--upload-pack=touch evil"}, {"tree": "HEAD"}, {"base": "../x"}, {"others": [{"commit": "-x"}]}]
MALICIOUS += [{"contents": []}, {"contents": {"a": 1}}, {"patch": "../../manifest.json"}]
MALICIOUS += [{"folders": ["../../elsewhere"]}, {"folders": ["/etc"]}]


@pytest.mark.parametrize("changes", MALICIOUS)
def test_a_record_with_paths_or_options_that_no_record_contains_is_refused(repository, tmp_path, changes):
    snapshot(repository, tmp_path / "run")
    change_record(tmp_path / "run", **changes)
    with pytest.raises(RunDirectoryError, match="source"):
        load_source(tmp_path / "run")
