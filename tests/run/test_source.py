import hashlib
import json
import os
import random
import shutil
import subprocess

import pytest

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run import git_commands as git_module
from wheelleg_exp.run.source_changes import source_lines
from wheelleg_exp.run.source_restore import load_source, restore_source
from wheelleg_exp.run.source_snapshot import snapshot_source

ODD = ["a b.txt", "tab\there", "new\nline", 'quo"te', "back\\slash", "ünï", "-dash", ":(top)x", "*"]
ODD += [os.fsdecode(b"\xff")]  # no UTF-8


def snapshot(root, folder, **keywords):
    snapshot_source(root if isinstance(root, list) else [root], folder / "source", **keywords)
    return json.loads((folder / "source" / "git.json").read_text())


def digests(folder):
    """Return content, mode and time of each file below a folder, without the times of git's objects."""
    found = {}
    for path in sorted(folder.rglob("*")):
        facts = path.lstat()
        content = path.readlink() if path.is_symlink() else path.read_bytes() if path.is_file() else b""
        timeless = path.is_dir() or "objects" in path.parts
        found[path] = (content, facts.st_mode, 0 if timeless else facts.st_mtime_ns)
    return found


def make_a_mess(repository, git):
    (repository / "gone.txt").unlink()
    (repository / "script.sh").chmod(0o755)
    for name, text in (("staged.py", "staged = 1\n"), ("intended.py", "i = 1\n")):
        (repository / name).write_text(text)
    git(repository, "add", "staged.py")
    git(repository, "add", "-N", "intended.py")
    (repository / "staged.py").write_text("staged = 2\n")
    for folder in ("odd", "ignored", "runs/walk"):
        (repository / folder).mkdir(parents=True)
    for name in ODD:
        (repository / "odd" / name).write_text(name, errors="surrogateescape")
    contents = {
        "package/code.py": b"x = 2\r\nno newline at the end",
        "new.bin": bytes(range(256)) * 4,
        "empty.txt": b"",
    }
    contents |= {"package/data.bin": hashlib.sha256(b"").digest() * 9}
    contents |= dict.fromkeys(("ignored/x", "a.log", "runs/walk/big.rrd"), b"never")
    for name, content in contents.items():
        (repository / name).write_bytes(content)
    (repository / "link").symlink_to("package/code.py")


def tree_by_plain_git(repository, git, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(repository, copy, symlinks=True)
    shutil.rmtree(copy / "runs", ignore_errors=True)
    git(copy, "add", "-A")
    return git(copy, "write-tree")


def tree_by_plain_apply(repository, git, tmp_path, patch, commit):
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "-q", "--no-hardlinks", str(repository), str(clone))
    git(clone, "checkout", "-q", commit)
    git(clone, "apply", "--index", "--whitespace=nowarn", str(patch))
    return git(clone, "write-tree"), clone


def test_the_patch_makes_the_recorded_tree_and_the_repository_stays_untouched(repository, git, tmp_path):
    make_a_mess(repository, git)
    git(repository, "remote", "add", "origin", "https://me:token@host.org/a/b.git")
    before = digests(repository)
    record = snapshot(repository / "package", tmp_path, runs_root=repository / "runs")
    assert digests(repository) == before
    patch = tmp_path / "source" / "source.patch"
    tree, clone = tree_by_plain_apply(repository, git, tmp_path, patch, record["commit"])
    assert (record["status"], record["branch"], record["dirty"]) == ("ok", "main", True)
    assert record["commit"] == git(repository, "rev-parse", "HEAD")
    assert record["remote"] == {"name": "origin", "url": "https://host.org/a/b.git"}
    assert record["root"] == str(repository)
    assert set(record["untracked"]) == {"new.bin", "empty.txt", "link", *(f"odd/{name}" for name in ODD)}
    assert json.loads((tmp_path / "source" / "git.json").read_text()) == record
    assert tree == record["tree"] == tree_by_plain_git(repository, git, tmp_path)
    assert record["patch_sha256"] == hashlib.sha256(patch.read_bytes()).hexdigest()
    for name in ("package/code.py", "package/data.bin", "new.bin", "staged.py", *(f"odd/{name}" for name in ODD)):
        assert (clone / name).read_bytes() == (repository / name).read_bytes(), name
    assert os.access(clone / "script.sh", os.X_OK)
    assert (clone / "link").is_symlink()
    assert not (clone / "gone.txt").exists()
    assert not (clone / "runs").exists()


def test_a_change_of_the_same_size_in_the_same_second_is_seen(repository, git, tmp_path):
    for attempt in range(3):
        path = repository / "package" / "code.py"
        path.write_text(f"x = {attempt}a\n")
        git(repository, "commit", "-qam", "same")
        path.write_text(f"x = {attempt}b\n")
        assert snapshot(repository, tmp_path)["dirty"] is True
        assert f"+x = {attempt}b" in (tmp_path / "source" / "source.patch").read_text()


@pytest.mark.parametrize("flag", ["--assume-unchanged", "--skip-worktree"])
def test_a_change_that_git_ignores_on_request_is_stored(repository, git, tmp_path, flag):
    git(repository, "update-index", flag, "package/code.py")
    (repository / "package" / "code.py").write_text("x = 'overlooked'\n")
    snapshot(repository, tmp_path)
    assert b"overlooked" in (tmp_path / "source" / "source.patch").read_bytes()


def test_the_users_diff_settings_change_nothing(repository, git, tmp_path):
    make_a_mess(repository, git)
    plain = snapshot(repository, tmp_path / "plain", runs_root=repository / "runs")
    settings = {"diff.noprefix": "true", "diff.mnemonicPrefix": "true", "color.ui": "always", "diff.relative": "true"}
    settings |= {"diff.external": "false", "diff.renames": "copies", "diff.context": "0", "core.quotePath": "false"}
    for key, value in settings.items():
        git(repository, "config", key, value)
    git(repository, "config", "diff.odd.command", "false")
    hook = "hooks/post-index-change"
    for name, text in (("info/attributes", "*.py diff=odd\n"), (hook, f"#!/bin/sh\ntouch {tmp_path}/hook-ran\n")):
        (repository / ".git" / name).parent.mkdir(exist_ok=True)
        (repository / ".git" / name).write_text(text)
    (repository / ".git" / hook).chmod(0o755)
    odd = snapshot(repository, tmp_path / "odd", runs_root=repository / "runs")
    assert odd["tree"] == plain["tree"]
    assert not (tmp_path / "hook-ran").exists()
    patch = tmp_path / "odd" / "source" / "source.patch"
    assert tree_by_plain_apply(repository, git, tmp_path, patch, odd["commit"])[0] == plain["tree"]


def test_it_works_from_another_folder_and_inside_a_hook(repository, git, tmp_path, monkeypatch):
    (repository / "package" / "code.py").write_text("x = 5\n")
    (repository / "new.py").write_text("")
    expected = snapshot(repository, tmp_path / "a")
    other = tmp_path / "other"
    git(tmp_path, "init", "-q", str(other))
    monkeypatch.chdir(other)
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_INDEX_FILE", str(other / ".git" / "index"))
    assert snapshot(repository, tmp_path / "b") == expected


def test_linked_working_trees_and_shallow_clones_are_captured_like_repositories(repository, git, tmp_path):
    git(repository, "worktree", "add", "-q", "-b", "side", str(tmp_path / "linked"))
    (tmp_path / "linked" / "package" / "code.py").write_text("x = 'linked'\n")
    assert snapshot(tmp_path / "linked" / "package", tmp_path)["branch"] == "side"
    assert b"linked" in (tmp_path / "source" / "source.patch").read_bytes()
    git(repository, "checkout", "-q", "--detach")  # The main working tree is clean.
    record = snapshot(repository, tmp_path)
    assert (record["branch"], record["dirty"]) == (None, False)
    assert record["tree"] == git(repository, "rev-parse", "HEAD^{tree}")
    assert (tmp_path / "source" / "source.patch").read_bytes() == b""
    (repository / "gone.txt").unlink()
    git(repository, "commit", "-qam", "second")
    git(tmp_path, "clone", "-q", "--depth", "1", f"file://{repository}", "shallow")
    (tmp_path / "shallow" / "package" / "code.py").write_text("x = 'shallow'\n")
    record = snapshot(tmp_path / "shallow", tmp_path)
    assert (record["status"], record["shallow"], record["commit"]) == ("ok", True, git(repository, "rev-parse", "HEAD"))
    assert record["changed"] == ["package/code.py"]


@pytest.mark.parametrize(("name", "tracked"), [("big.csv", False), ("package/data.bin", True)])
def test_changes_over_the_cap_are_refused_with_the_big_files(repository, git, tmp_path, name, tracked):
    (repository / name).write_bytes(random.Random(0).randbytes(300_000))
    if not tracked:
        (repository / "small.py").write_text("x\n")
    record = snapshot(repository, tmp_path, max_patch_mb=0.1)
    assert (record["status"], record["patch"]) == ("patch_too_large", None)
    assert record["big_files"][0] == {"path": name, "bytes": 300_000}
    assert not (tmp_path / "source" / "source.patch").exists()
    assert [word for word in (name, "run.max_patch_mb") if word not in record["note"]] == []
    assert snapshot(repository, tmp_path, max_patch_mb=1.0)["status"] == "ok"


def test_a_repository_without_commits_has_no_base(tmp_path, git):
    folder = tmp_path / "fresh"
    git(tmp_path, "init", "-q", str(folder))
    (folder / "a.py").write_text("a = 1\n")
    (folder / "b.bin").write_bytes(bytes(range(256)))
    git(folder, "add", "a.py")
    record = snapshot(folder, tmp_path)
    assert record["status"] == "no_commits"
    assert record["commit"] is None
    assert record["tree"] == tree_by_plain_git(folder, git, tmp_path)
    again = tmp_path / "again"
    git(tmp_path, "init", "-q", str(again))
    git(again, "apply", "--index", str(tmp_path / "source" / "source.patch"))
    assert git(again, "write-tree") == record["tree"]


@pytest.mark.parametrize("ignored", [True, False])
def test_a_package_in_an_environment_inside_a_repository_is_installed(repository, git, tmp_path, ignored):
    environment = repository / ("ignored" if ignored else "venv")
    package = environment / "lib" / "python3" / "site-packages" / "package"
    package.mkdir(parents=True)
    (package / "code.py").write_text("x = 1\n")
    first = snapshot(package, tmp_path)
    assert first["status"] == "installed"
    assert first["commit"] is None
    (package / "code.py").write_text("x = 2\n")
    assert snapshot(package, tmp_path)["content_sha256"] != first["content_sha256"]


def test_without_a_working_git_the_source_is_not_captured_and_the_run_continues(repository, git, tmp_path, monkeypatch):
    def hang(*arguments, **keywords):
        raise subprocess.TimeoutExpired("git", 1)

    with monkeypatch.context() as patch:
        patch.setattr(git_module.subprocess, "run", hang)
        assert snapshot(repository, tmp_path)["status"] == "failed"
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))
        assert snapshot(repository, tmp_path)["status"] == "no_git"
    (repository / ".git" / "index").write_bytes(b"not an index, but as long as an index must be")
    record = snapshot(repository, tmp_path)
    assert (record["status"], record["patch"], record["exact"]) == ("failed", None, False)
    assert "bad signature" in record["note"]


def test_a_changed_file_that_cannot_be_read_is_named(repository, git, tmp_path, monkeypatch):
    (repository / "package" / "code.py").write_text("x = 2\n")
    (repository / "gone.txt").write_text("changed\n")
    run = git_module.run_git

    def unreadable(folder, *arguments, **keywords):
        if arguments[0] == "add":
            if "--ignore-errors" in arguments:
                run(folder, "update-index", "gone.txt", **keywords)
            raise git_module.GitError('open("package/code.py"): Permission denied')
        return run(folder, *arguments, **keywords)

    monkeypatch.setattr(git_module, "run_git", unreadable)
    record = snapshot(repository, tmp_path)
    assert (record["status"], record["changed"]) == ("ok", ["gone.txt"])
    assert record["refused"][0]["path"] == "package/code.py"
    assert "Permission denied" in record["refused"][0]["reason"]


def test_roots_of_one_repository_count_once_and_others_get_their_own_patch(repository, git, tmp_path):
    user = tmp_path / "user"
    git(tmp_path, "init", "-q", "-b", "mine", str(user))
    (user / "robot.yaml").write_text("a: 1\n")
    (repository / "configs").mkdir()
    (repository / "configs" / "x.yaml").write_text("x: 1\n")
    record = snapshot([repository / "package", repository / "configs", user], tmp_path)
    assert record["folders"] == ["package", "configs"]
    (other,) = record["others"]
    assert (other["root"], other["branch"], other["patch"]) == (str(user), "mine", "source_2.patch")
    assert b"robot.yaml" in (tmp_path / "source" / "source_2.patch").read_bytes()
    restore_source(tmp_path, tmp_path / "again", which=1)
    assert (tmp_path / "again" / "robot.yaml").read_text() == "a: 1\n"


def test_the_recorded_tree_can_be_made_again(repository, git, tmp_path):
    make_a_mess(repository, git)
    git(repository, "config", "core.autocrlf", "true")
    record = snapshot(repository, tmp_path, runs_root=repository / "runs")
    git(repository, "config", "core.autocrlf", "false")
    before = digests(repository)
    tree = restore_source(tmp_path, tmp_path / "again")
    assert (tree, git(tmp_path / "again", "write-tree")) == (record["tree"], tree)
    assert (tmp_path / "again" / "new.bin").read_bytes() == (repository / "new.bin").read_bytes()
    assert digests(repository) == before


def test_an_installed_package_is_recorded_with_its_distribution_and_cannot_be_restored(tmp_path, git):
    folder = tmp_path / "site-packages"
    for name in ("package", "package-1.2.dist-info"):
        (folder / name).mkdir(parents=True)
    (folder / "package" / "code.py").write_text("x = 1\n")
    (folder / "package-1.2.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: Package\nVersion: 1.2\n")
    (folder / "package-1.2.dist-info" / "RECORD").write_text("package/code.py,,\n")
    record = snapshot(folder / "package", tmp_path)
    assert (record["status"], record["distribution"]) == ("installed", "Package==1.2")
    with pytest.raises(RunDirectoryError, match=r"did not store its source code.*is installed"):
        restore_source(tmp_path, tmp_path / "again")


@pytest.fixture(params=["plain folder", "loose file", "foreign owner", "ignored folder"])
def uncaptured(request, repository, git, tmp_path, monkeypatch):
    """A source that git does not manage, and the reason."""
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "helpers.py").write_text("x = 1\n")
    if request.param == "foreign owner":
        monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")  # Git's own tests use this variable.
        return repository / "package", "belongs to another user"
    if request.param == "ignored folder":
        (repository / "ignored").mkdir()
        return repository / "ignored", "is ignored by the repository around it"
    return plain if request.param == "plain folder" else plain / "helpers.py", "is not in a git repository"


def test_a_source_without_git_is_named_as_not_captured(uncaptured, repository, tmp_path):
    root, reason = uncaptured
    record = snapshot(root, tmp_path)
    assert (record["status"], record["root"], record["exact"]) == ("no_repository", str(root), False)
    assert record["patch"] is record["tree"] is None
    assert reason in record["note"]
    assert source_lines(load_source(tmp_path)) == [f"warning: the source is not captured: {record['note']}"]
    with pytest.raises(RunDirectoryError, match="did not store its source code"):
        restore_source(tmp_path, tmp_path / "again")


def test_files_with_a_filter_such_as_lfs_are_named_as_not_captured_and_no_filter_runs(repository, git, tmp_path):
    (repository / ".gitattributes").write_text("*.stl filter=lfs\n*.crypt filter=seal\n")
    (repository / "old.stl").write_text("pointer 1\n")
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "pointers")
    for name in ("lfs", "seal"):
        git(repository, "config", f"filter.{name}.clean", f"touch {tmp_path}/ran; echo pointer")
        git(repository, "config", f"filter.{name}.required", "true")
    for name in ("old.stl", "mesh.stl", "notes.crypt"):
        (repository / name).write_text("hunter2\n")
    record = snapshot(repository, tmp_path)
    assert (record["status"], record["exact"]) == ("ok", False)
    assert not (tmp_path / "ran").exists()
    reasons = {entry["path"]: entry["reason"] for entry in record["refused"]}
    assert reasons == {
        "mesh.stl": "git passes it through the filter 'lfs'",
        "old.stl": "git passes it through the filter 'lfs'",
        "notes.crypt": "git passes it through the filter 'seal'",
    }
    assert b"hunter2" not in (tmp_path / "source" / "source.patch").read_bytes()
    assert record["tree"] == git(repository, "rev-parse", "HEAD^{tree}")


def test_nested_repositories_and_submodules_are_named_as_not_captured(repository, git, tmp_path):
    library = tmp_path / "library"
    shutil.copytree(repository, library)
    for name in ("nested", "unborn"):
        (repository / name).mkdir()
        git(repository / name, "init", "-q")
        (repository / name / "x").write_text("x")
    git(repository / "nested", "add", "-A")
    git(repository / "nested", "commit", "-qm", "x")
    git(repository, "-c", "protocol.file.allow=always", "submodule", "--quiet", "add", str(library), "library")
    git(repository, "commit", "-qm", "submodule")
    commit = git(repository / "library", "rev-parse", "HEAD")
    (repository / "library" / "new.py").write_text("n = 1\n")
    record = snapshot(repository, tmp_path)
    assert (record["status"], record["exact"], record["others"]) == ("ok", False, [])
    assert {entry["path"] for entry in record["refused"]} == {"nested/", "unborn/"}
    assert record["submodules"] == [{"path": "library", "commit": commit}]
    assert record["note"] == "files not captured: nested/, unborn/; submodules not captured: library"


def test_one_console_line_describes_each_source(repository, git, tmp_path):
    def lines(*roots, **keywords):
        return source_lines(snapshot_source(roots, tmp_path / "source", **keywords))

    commit = git(repository, "rev-parse", "HEAD")[:10]
    assert lines(repository) == [f"source: commit {commit} of {repository} on main, clean"]
    (repository / "new.py").write_text("")
    (repository / "nested").mkdir()
    git(repository / "nested", "init", "-q")
    plain = tmp_path / "plain"
    plain.mkdir()
    assert lines(repository, plain) == [
        f"source: commit {commit} of {repository} on main, with changes: 1 file (1 untracked), "
        "stored in source/source.patch",
        f"warning: not captured of the source of {repository}: 'nested/' (it is a repository of its own)",
        f"warning: the source is not captured: '{plain}' is not in a git repository, so its files are not captured",
    ]
    (repository / "big.csv").write_bytes(bytes(300_000))
    warning = "warning: the source is not captured: the untracked files have"
    assert lines(repository, max_patch_mb=0.1)[0].startswith(warning)
