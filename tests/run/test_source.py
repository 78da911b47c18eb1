from __future__ import annotations

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
from wheelleg_exp.run.source_restore import restore_source
from wheelleg_exp.run.source_snapshot import snapshot_source

ODD = ["a b.txt", "tab\there", "new\nline", 'quo"te', "back\\slash", "ünï", "-dash", ":(top)x", "*"]
ODD += [os.fsdecode(b"\xff")]  # no UTF-8
KEY = b"-----BEGIN PRIVATE" + b" KEY-----\nMII\n"


def snapshot(root, folder, **keywords):
    roots = root if isinstance(root, list) else [root]
    return snapshot_source(roots, folder / "source", **keywords)


def digests(folder):
    """Content, mode and time of everything below a folder (git renews the times of objects that it has)."""
    found = {}
    for path in sorted(folder.rglob("*")):
        facts = path.lstat()
        content = path.readlink() if path.is_symlink() else path.read_bytes() if path.is_file() else b""
        timeless = path.is_dir() or "objects" in path.parts
        found[path] = (content, facts.st_mode, 0 if timeless else facts.st_mtime_ns)
    return found


def make_a_mess(repository, git):
    """Every kind of change at once."""
    (repository / "package" / "code.py").write_bytes(b"x = 2\r\nno newline at the end")
    (repository / "package" / "data.bin").write_bytes(hashlib.sha256(b"").digest() * 9)
    (repository / "gone.txt").unlink()
    (repository / "script.sh").chmod(0o755)
    (repository / "staged.py").write_text("staged = 1\n")
    git(repository, "add", "staged.py")
    (repository / "staged.py").write_text("staged = 2\n")
    (repository / "intended.py").write_text("i = 1\n")
    git(repository, "add", "-N", "intended.py")
    (repository / "odd").mkdir()
    for name in ODD:
        (repository / "odd" / name).write_text(name, errors="surrogateescape")
    (repository / "new.bin").write_bytes(bytes(range(256)) * 4)
    (repository / "empty.txt").write_bytes(b"")
    (repository / "link").symlink_to("package/code.py")
    (repository / "ignored").mkdir()
    (repository / "ignored" / "x").write_text("never")
    (repository / "a.log").write_text("never")
    (repository / "runs" / "walk").mkdir(parents=True)
    (repository / "runs" / "walk" / "big.rrd").write_text("never")


def tree_by_plain_git(repository, git, tmp_path):
    """The tree that plain git makes of a copy of the whole folder."""
    copy = tmp_path / "copy"
    shutil.copytree(repository, copy, symlinks=True)
    shutil.rmtree(copy / "runs", ignore_errors=True)
    git(copy, "add", "-A")
    return git(copy, "write-tree")


def tree_by_plain_apply(repository, git, tmp_path, patch, commit):
    """The tree that the patch makes of a clean clone, with nothing but git's own commands."""
    clone = tmp_path / "clone"
    git(tmp_path, "clone", "-q", "--no-hardlinks", str(repository), str(clone))
    git(clone, "checkout", "-q", commit)
    git(clone, "apply", "--index", "--whitespace=nowarn", str(patch))
    return git(clone, "write-tree"), clone


def test_the_patch_makes_the_recorded_tree_from_a_clean_clone(repository, git, tmp_path):
    make_a_mess(repository, git)
    record = snapshot(repository / "package", tmp_path, runs_root=repository / "runs")
    patch = tmp_path / "source" / "source.patch"
    tree, clone = tree_by_plain_apply(repository, git, tmp_path, patch, record["commit"])
    assert record["status"] == "ok"
    assert tree == record["tree"] == tree_by_plain_git(repository, git, tmp_path)
    assert record["patch_sha256"] == hashlib.sha256(patch.read_bytes()).hexdigest()
    names = ["package/code.py", "package/data.bin", "new.bin", "staged.py", *(f"odd/{name}" for name in ODD)]
    for name in names:
        assert (clone / name).read_bytes() == (repository / name).read_bytes(), name
    assert os.access(clone / "script.sh", os.X_OK)
    assert (clone / "link").is_symlink()
    assert not (clone / "gone.txt").exists()
    assert not (clone / "runs").exists()


def test_the_record_says_what_it_holds(repository, git, tmp_path):
    make_a_mess(repository, git)
    git(repository, "remote", "add", "origin", "https://me:token@host.org/a/b.git")
    snapshot(repository / "package", tmp_path, runs_root=repository / "runs")
    record = json.loads((tmp_path / "source" / "git.json").read_text())
    assert record["commit"] == git(repository, "rev-parse", "HEAD")
    assert record["branch"] == "main"
    assert record["remote"] == {"name": "origin", "url": "https://host.org/a/b.git"}
    assert record["dirty"] is True
    assert record["root"] == str(repository)
    expected = {"new.bin", "empty.txt", "link", *(f"odd/{name}" for name in ODD)}
    assert set(record["untracked"]) == expected
    assert "token" not in (tmp_path / "source" / "git.json").read_text()


def test_index_objects_and_working_tree_stay_untouched_to_the_byte(repository, git, tmp_path):
    make_a_mess(repository, git)
    before = digests(repository)
    record = snapshot(repository, tmp_path, runs_root=repository / "runs")
    assert record["status"] == "ok"
    assert digests(repository) == before


def test_a_clean_tree_has_the_tree_of_its_commit_and_an_empty_patch(repository, git, tmp_path):
    record = snapshot(repository, tmp_path)
    assert record["dirty"] is False
    assert record["tree"] == git(repository, "rev-parse", "HEAD^{tree}")
    assert (tmp_path / "source" / "source.patch").read_bytes() == b""


def test_a_change_of_the_same_size_in_the_same_second_is_seen(repository, git, tmp_path):
    for attempt in range(3):
        path = repository / "package" / "code.py"
        path.write_text(f"x = {attempt}a\n")
        git(repository, "commit", "-qam", "same")
        path.write_text(f"x = {attempt}b\n")
        record = snapshot(repository, tmp_path)
        assert record["dirty"] is True
        assert f"+x = {attempt}b" in (tmp_path / "source" / "source.patch").read_text()


@pytest.mark.parametrize("flag", ["--assume-unchanged", "--skip-worktree"])
def test_a_change_that_git_was_told_to_overlook_is_kept(repository, git, tmp_path, flag):
    git(repository, "update-index", flag, "package/code.py")
    (repository / "package" / "code.py").write_text("x = 'overlooked'\n")
    snapshot(repository, tmp_path)
    assert b"overlooked" in (tmp_path / "source" / "source.patch").read_bytes()


def test_the_users_diff_settings_change_nothing(repository, git, tmp_path):
    make_a_mess(repository, git)
    plain = snapshot(repository, tmp_path / "plain", runs_root=repository / "runs")
    settings = {
        "diff.noprefix": "true",
        "diff.mnemonicPrefix": "true",
        "color.ui": "always",
        "diff.relative": "true",
    }
    settings |= {
        "diff.external": "false",
        "diff.renames": "copies",
        "diff.context": "0",
        "core.quotePath": "false",
    }
    for key, value in settings.items():
        git(repository, "config", key, value)
    git(repository, "config", "diff.odd.command", "false")
    (repository / ".git" / "info").mkdir(exist_ok=True)
    (repository / ".git" / "info" / "attributes").write_text("*.py diff=odd\n")
    (repository / ".git" / "hooks").mkdir(exist_ok=True)
    hook = repository / ".git" / "hooks" / "post-index-change"
    hook.write_text(f"#!/bin/sh\ntouch {tmp_path}/hook-ran\n")
    hook.chmod(0o755)
    odd = snapshot(repository, tmp_path / "odd", runs_root=repository / "runs")
    assert odd["tree"] == plain["tree"]
    assert not (tmp_path / "hook-ran").exists()
    tree, _ = tree_by_plain_apply(
        repository, git, tmp_path, tmp_path / "odd" / "source" / "source.patch", odd["commit"]
    )
    assert tree == plain["tree"]


def test_it_works_from_another_folder_and_inside_a_hook(repository, git, tmp_path, monkeypatch):
    (repository / "package" / "code.py").write_text("x = 5\n")
    (repository / "new.py").write_text("")
    expected = snapshot(repository, tmp_path / "a")
    other = tmp_path / "other"
    other.mkdir()
    git(other, "init", "-q")
    monkeypatch.chdir(other)
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_INDEX_FILE", str(other / ".git" / "index"))
    assert snapshot(repository, tmp_path / "b") == expected


def test_a_linked_working_tree_is_its_own(repository, git, tmp_path):
    git(repository, "worktree", "add", "-q", "-b", "side", str(tmp_path / "linked"))
    (tmp_path / "linked" / "package" / "code.py").write_text("x = 'linked'\n")
    record = snapshot(tmp_path / "linked" / "package", tmp_path)
    assert record["branch"] == "side"
    assert b"linked" in (tmp_path / "source" / "source.patch").read_bytes()


def test_a_detached_head_has_no_branch(repository, git, tmp_path):
    git(repository, "checkout", "-q", "--detach")
    assert snapshot(repository, tmp_path)["branch"] is None


def test_keys_and_tokens_are_left_out_by_name_and_by_content(repository, git, tmp_path):
    (repository / ".env").write_text("PASSWORD=hunter2\n")
    (repository / "notes.txt").write_bytes(b"hunter2\n" + KEY)
    (repository / "fine.txt").write_text("fine\n")
    record = snapshot(repository, tmp_path)
    patch = (tmp_path / "source" / "source.patch").read_bytes()
    assert {entry["path"] for entry in record["refused"]} == {".env", "notes.txt"}
    assert record["untracked"] == ["fine.txt"]
    assert b"hunter2" not in patch
    assert b"fine" in patch
    assert record["note"] == "left out: .env, notes.txt"
    tree, _ = tree_by_plain_apply(repository, git, tmp_path, tmp_path / "source" / "source.patch", record["commit"])
    assert tree == record["tree"]


def test_a_staged_a_changed_and_a_deleted_secret_do_not_get_into_the_patch(repository, git, tmp_path):
    for name in ("server.pem", "old.txt", "cleaned.txt"):
        (repository / name).write_bytes(b"committed hunter2\n" + KEY)
    git(repository, "add", "-A")
    git(repository, "commit", "-qm", "oops")
    (repository / "server.pem").write_bytes(b"changed hunter2\n")
    (repository / "old.txt").unlink()
    (repository / "cleaned.txt").write_bytes(b"committed hunter2\n")
    (repository / "fresh.key").write_bytes(b"staged hunter2\n")
    git(repository, "add", "fresh.key")
    record = snapshot(repository, tmp_path)
    assert {entry["path"] for entry in record["refused"]} == {
        "server.pem",
        "old.txt",
        "cleaned.txt",
        "fresh.key",
    }
    assert b"hunter2" not in (tmp_path / "source" / "source.patch").read_bytes()
    assert record["dirty"] is True
    assert record["tree"] == git(repository, "rev-parse", "HEAD^{tree}")


def test_untracked_files_over_the_cap_are_refused_with_their_names(repository, git, tmp_path):
    (repository / "big.csv").write_bytes(bytes(300_000))
    (repository / "small.py").write_text("x\n")
    record = snapshot(repository, tmp_path, max_patch_mb=0.1)
    assert record["status"] == "patch_too_large"
    assert record["patch"] is None
    assert not (tmp_path / "source" / "source.patch").exists()
    assert record["big_files"][0] == {"path": "big.csv", "bytes": 300_000}
    assert "big.csv" in record["note"]
    assert "run.max_patch_mb" in record["note"]


def test_a_file_that_is_left_out_does_not_count_towards_the_cap(repository, git, tmp_path):
    (repository / "token.bin").write_bytes(bytes(300_000))
    record = snapshot(repository, tmp_path, max_patch_mb=0.1)
    assert record["status"] == "ok"
    assert [entry["path"] for entry in record["refused"]] == ["token.bin"]
    assert record["dirty"] is True


def test_a_patch_over_the_cap_is_refused_with_the_big_files(repository, git, tmp_path):
    (repository / "package" / "data.bin").write_bytes(random.Random(0).randbytes(300_000))
    record = snapshot(repository, tmp_path, max_patch_mb=0.1)
    assert record["status"] == "patch_too_large"
    assert record["big_files"] == [{"path": "package/data.bin", "bytes": 300_000}]
    assert not (tmp_path / "source" / "source.patch").exists()
    assert snapshot(repository, tmp_path, max_patch_mb=1.0)["status"] == "ok"


def test_a_folder_without_a_repository_is_kept_as_a_patch_from_nothing(tmp_path, git):
    folder = tmp_path / "plain"
    (folder / "configs" / "task").mkdir(parents=True)
    (folder / "configs" / "task" / "mine.yaml").write_bytes(b"a: 1\r\n")
    for name in ODD:
        (folder / name).write_text(name, errors="surrogateescape")
    (folder / "link").symlink_to("configs/task/mine.yaml")
    (folder / ".gitignore").write_text("*.log\n")
    for name in (
        "a.log",
        "__pycache__/x.pyc",
        "venv/pyvenv.cfg",
        "venv/lib/x.py",
        ".env",
        "runs/stand/1/manifest.json",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("never")
    before = digests(folder)
    record = snapshot(folder, tmp_path, runs_root=folder / "runs")
    assert (record["status"], record["commit"], record["dirty"]) == ("no_repository", None, True)
    assert "is in no git repository" in record["note"]
    assert digests(folder) == before
    assert {entry["path"] for entry in record["refused"]} == {"venv/", ".env"}
    assert restore_source(tmp_path, tmp_path / "again") == record["tree"]
    kept = {path: content for path, content in digests(tmp_path / "again").items() if ".git" not in path.parts}
    names = {path.relative_to(tmp_path / "again").as_posix() for path in kept if path.is_symlink() or path.is_file()}
    assert names == {"configs/task/mine.yaml", "link", ".gitignore", *ODD}
    for name in names - {"link"}:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()


def test_a_plain_folder_over_the_cap_says_so(tmp_path, git):
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / "big.csv").write_bytes(bytes(300_000))
    record = snapshot(tmp_path / "plain", tmp_path, max_patch_mb=0.1)
    assert record["status"] == "patch_too_large"
    assert "no git repository" in record["note"]
    assert "big.csv" in record["note"]


def test_a_loose_file_is_kept_alone(tmp_path, git):
    for name in ("helpers.py", "diary.txt"):
        (tmp_path / name).write_text(name)
    record = snapshot(tmp_path / "helpers.py", tmp_path / "run")
    assert (record["status"], record["folders"], record["changed"]) == ("no_repository", ["helpers.py"], ["helpers.py"])


def test_a_repository_of_another_user_is_kept_as_a_folder(repository, git, tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")  # git's own way to test its refusal
    record = snapshot(repository / "package", tmp_path)
    assert record["status"] == "no_repository"
    assert "belongs to another user" in record["note"]
    assert record["changed"] == ["code.py", "data.bin"]


def test_a_repository_without_commits_is_held_against_nothing(tmp_path, git):
    folder = tmp_path / "fresh"
    folder.mkdir()
    git(folder, "init", "-q")
    (folder / "a.py").write_text("a = 1\n")
    (folder / "b.bin").write_bytes(bytes(range(256)))
    git(folder, "add", "a.py")
    record = snapshot(folder, tmp_path)
    assert record["status"] == "no_commits"
    assert record["commit"] is None
    assert record["tree"] == tree_by_plain_git(folder, git, tmp_path)
    again = tmp_path / "again"
    again.mkdir()
    git(again, "init", "-q")
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


def test_an_ignored_folder_that_is_named_is_kept_as_a_folder(repository, git, tmp_path):
    (repository / "ignored").mkdir()
    (repository / "ignored" / "mine.yaml").write_text("a: 1\n")
    record = snapshot([repository, repository / "ignored"], tmp_path)
    assert record["dirty"] is False
    (other,) = record["others"]
    assert (other["status"], other["changed"]) == ("no_repository", ["mine.yaml"])
    assert "is ignored by the repository around it" in other["note"]


def test_an_installed_package_without_any_repository_is_installed(tmp_path, git):
    package = tmp_path / "site-packages" / "package"
    package.mkdir(parents=True)
    assert snapshot(package, tmp_path)["status"] == "installed"


def test_without_git_the_run_goes_on(repository, tmp_path, git, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert snapshot(repository, tmp_path)["status"] == "no_git"


def test_a_repository_that_git_cannot_read_is_kept_as_a_folder(repository, tmp_path, git):
    (repository / ".git" / "index").write_bytes(b"not an index, but long enough to look at")
    record = snapshot(repository, tmp_path)
    assert record["status"] == "no_repository"
    assert "bad signature" in record["note"]
    assert "package/code.py" in record["changed"]


def test_a_shallow_clone_is_kept_like_any_other(repository, git, tmp_path):
    (repository / "gone.txt").unlink()
    git(repository, "commit", "-qam", "second")
    clone = tmp_path / "shallow"
    git(tmp_path, "clone", "-q", "--depth", "1", f"file://{repository}", str(clone))
    (clone / "package" / "code.py").write_text("x = 'shallow'\n")
    record = snapshot(clone, tmp_path)
    assert (record["status"], record["shallow"]) == ("ok", True)
    assert record["commit"] == git(repository, "rev-parse", "HEAD")
    assert record["changed"] == ["package/code.py"]


def test_no_filter_program_runs_and_big_files_are_kept_with_their_content(repository, git, tmp_path):
    (repository / ".gitattributes").write_text("*.stl filter=lfs\n*.crypt filter=seal\n")
    for name in ("lfs", "seal"):
        git(repository, "config", f"filter.{name}.clean", f"touch {tmp_path}/ran; echo pointer")
        git(repository, "config", f"filter.{name}.required", "true")
    for name in ("mesh.stl", "notes.crypt"):
        (repository / name).write_text("hunter2\n")
    record = snapshot(repository, tmp_path)
    assert record["status"] == "ok"
    assert not (tmp_path / "ran").exists()
    assert record["refused"] == [{"path": "notes.crypt", "reason": "the filter 'seal' stands between it and git"}]
    patch = (tmp_path / "source" / "source.patch").read_bytes()
    assert patch.count(b"hunter2") == 1
    assert b"pointer" not in patch


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
    assert record["status"] == "ok"
    assert record["changed"] == ["gone.txt"]
    assert record["refused"][0]["path"] == "package/code.py"
    assert "Permission denied" in record["refused"][0]["reason"]


def test_roots_of_one_repository_count_once_and_others_get_their_own_patch(repository, git, tmp_path):
    user = tmp_path / "user"
    user.mkdir()
    git(user, "init", "-q", "-b", "mine")
    (user / "robot.yaml").write_text("a: 1\n")
    (repository / "configs").mkdir()
    (repository / "configs" / "x.yaml").write_text("x: 1\n")
    record = snapshot([repository / "package", repository / "configs", user], tmp_path)
    assert record["folders"] == ["package", "configs"]
    (other,) = record["others"]
    assert other["root"] == str(user)
    assert other["branch"] == "mine"
    assert other["patch"] == "source_2.patch"
    assert b"robot.yaml" in (tmp_path / "source" / "source_2.patch").read_bytes()


def test_nested_repositories_are_named(repository, git, tmp_path):
    for name in ("nested", "unborn"):
        (repository / name).mkdir()
        git(repository / name, "init", "-q")
        (repository / name / "x").write_text("x")
    git(repository / "nested", "add", "-A")
    git(repository / "nested", "commit", "-qm", "x")
    record = snapshot(repository, tmp_path)
    assert record["status"] == "ok"
    assert {entry["path"] for entry in record["refused"]} == {"nested/", "unborn/"}


def test_submodules_are_recorded_by_commit_and_those_checked_out_are_kept_as_well(repository, git, tmp_path):
    library = tmp_path / "library"
    shutil.copytree(repository, library)
    for name in ("library", "absent"):
        git(repository, "-c", "protocol.file.allow=always", "submodule", "--quiet", "add", str(library), name)
    git(repository, "commit", "-qm", "submodules")
    git(repository, "submodule", "--quiet", "deinit", "-f", "absent")
    git(repository / "library", "commit", "-q", "--allow-empty", "-m", "next")
    (repository / "library" / "new.py").write_text("n = 1\n")
    record = snapshot([repository, repository / "library" / "package"], tmp_path)
    commit = git(repository / "library", "rev-parse", "HEAD")
    assert {"path": "library", "commit": commit} in record["submodules"]
    assert record["note"] == "submodules that are not checked out: absent"
    (other,) = record["others"]
    assert (other["root"], other["commit"], other["untracked"]) == (str(repository / "library"), commit, ["new.py"])
    assert [entry["root"] for entry in snapshot(repository, tmp_path)["others"]] == [str(repository / "library")]


def test_the_recorded_tree_can_be_made_again(repository, git, tmp_path):
    make_a_mess(repository, git)
    git(repository, "config", "core.autocrlf", "true")
    record = snapshot(repository, tmp_path, runs_root=repository / "runs")
    git(repository, "config", "core.autocrlf", "false")
    before = digests(repository)
    tree = restore_source(tmp_path, tmp_path / "again")
    assert tree == record["tree"]
    assert git(tmp_path / "again", "write-tree") == tree
    assert (tmp_path / "again" / "new.bin").read_bytes() == (repository / "new.bin").read_bytes()
    assert digests(repository) == before


def test_a_second_repository_and_an_unborn_one_can_be_made_again(repository, git, tmp_path):
    user = tmp_path / "user"
    user.mkdir()
    git(user, "init", "-q")
    (user / "robot.yaml").write_text("a: 1\n")
    snapshot([repository, user], tmp_path)
    restore_source(tmp_path, tmp_path / "again", which=1)
    assert (tmp_path / "again" / "robot.yaml").read_text() == "a: 1\n"


def test_a_source_that_cannot_be_made_again_leaves_nothing(repository, git, tmp_path):
    (repository / "package" / "code.py").write_text("x = 3\n")
    record = snapshot(repository, tmp_path)
    unrelated = tmp_path / "unrelated"
    unrelated.mkdir()
    git(unrelated, "init", "-q")
    with pytest.raises(RunDirectoryError, match=f"holds commit {record['commit']}"):
        restore_source(tmp_path, tmp_path / "out" / "again", unrelated)
    path = tmp_path / "source" / "source.patch"
    path.write_bytes(path.read_bytes().replace(b"x = 3", b"x = 4"))
    with pytest.raises(RunDirectoryError, match="expected the recorded"):
        restore_source(tmp_path, tmp_path / "out" / "again")
    assert not list(tmp_path.glob("out/*"))


def test_a_source_that_was_not_kept_says_why(tmp_path, git):
    (tmp_path / "site-packages" / "package").mkdir(parents=True)
    snapshot(tmp_path / "site-packages" / "package", tmp_path)
    with pytest.raises(RunDirectoryError, match=r"was not kept.*is installed"):
        restore_source(tmp_path, tmp_path / "again")


def test_an_installed_package_is_recorded_with_its_distribution(tmp_path, git):
    folder = tmp_path / "site-packages"
    for name in ("package", "package-1.2.dist-info"):
        (folder / name).mkdir(parents=True)
    (folder / "package" / "code.py").write_text("x = 1\n")
    (folder / "package-1.2.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: Package\nVersion: 1.2\n")
    (folder / "package-1.2.dist-info" / "RECORD").write_text("package/code.py,,\n")
    record = snapshot(folder / "package", tmp_path)
    assert (record["status"], record["distribution"]) == ("installed", "Package==1.2")


def test_the_console_is_told_in_a_line_what_is_kept(repository, git, tmp_path):
    def said(*roots, **keywords):
        return source_lines(snapshot(list(roots), tmp_path, **keywords))

    commit = git(repository, "rev-parse", "HEAD")[:10]
    assert said(repository) == [f"source: commit {commit} of {repository} on main, clean"]
    (repository / "new.py").write_text("")
    (repository / ".env").write_text("")
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "a.yaml").write_text("a: 1\n")
    assert said(repository, plain) == [
        f"source: commit {commit} of {repository} on main, with changes: 1 file (1 untracked), "
        "kept in source/source.patch",
        f"warning: left out of the source of {repository}: '.env' (its name matches .env)",
        f"source: {plain} is in no repository that git reads; 1 file, kept in source/source_2.patch",
    ]
    (repository / "big.csv").write_bytes(bytes(300_000))
    assert said(repository, max_patch_mb=0.1)[0].startswith("warning: the source is not kept: the untracked files have")


def test_git_that_hangs_is_given_up(repository, git, tmp_path, monkeypatch):
    def hang(*arguments, **keywords):
        raise subprocess.TimeoutExpired("git", 1)

    monkeypatch.setattr(git_module.subprocess, "run", hang)
    assert snapshot(repository, tmp_path)["status"] == "failed"
