import os
from dataclasses import replace

import pytest

from wheelleg_exp.run.source_changes import describe_changes
from wheelleg_exp.run.source_snapshot import snapshot_source


@pytest.fixture
def record(tmp_path):
    """Record the state of a source folder in a new run directory."""
    count = iter(range(100))
    return lambda root, **keywords: snapshot_source([root], tmp_path / f"source_{next(count)}", **keywords)[0]


@pytest.fixture
def folder(tmp_path, git):
    path = tmp_path / "plain"
    (path / "pet").mkdir(parents=True)
    git(path, "init", "-q")
    for name in ("a.py", "b.py", "c.py"):
        (path / "pet" / name).write_text(f"{name} = 1\n")
    return path


def test_every_kind_of_change_is_named(folder, record):
    was = record(folder)
    (folder / "pet" / "a.py").write_text("other\n")
    (folder / "pet" / "b.py").unlink()
    (folder / "pet" / "d.py").write_text("new\n")
    (folder / "pet" / "c.py").chmod(0o755)
    now = record(folder)
    assert was.tree != now.tree
    assert describe_changes(was, now, []) == f"{folder}: changed pet/a.py, pet/c.py; added pet/d.py; removed pet/b.py"
    assert describe_changes(was, was, []) == f"{folder}: no file differs"
    for index in range(9):
        (folder / f"{index}.py").write_text("x")
    assert describe_changes(now, record(folder), []).endswith("added 0.py, 1.py, 2.py and 6 more")


def test_uncommitted_changes_of_one_commit_are_named_without_a_repository(repository, record):
    (repository / "package" / "code.py").write_text("x = 2\n")
    (repository / "mine.py").write_text("1\n")
    was = record(repository)
    (repository / "package" / "code.py").write_text("x = 1\n")  # as committed
    (repository / "mine.py").unlink()
    (repository / "gone.txt").unlink()
    now = record(repository)
    assert describe_changes(was, now, []) == (f"{repository}: changed package/code.py; removed gone.txt, mine.py")


def test_what_has_been_committed_since_is_named_where_a_repository_holds_both(repository, record, git, tmp_path):
    (repository / "package" / "code.py").write_text("x = 2\n")
    (repository / "draft.py").write_text("1\n")
    was = record(repository)
    (repository / "draft.py").write_text("2\n")
    git(repository, "add", "-A")
    git(repository, "rm", "-q", "--cached", "gone.txt")
    git(repository, "commit", "-q", "-m", "second")
    (repository / "gone.txt").unlink()
    (repository / "later.py").write_text("3\n")
    now = record(repository)
    said = describe_changes(was, now, [tmp_path, repository])
    assert said == f"{repository}: changed draft.py; added later.py; removed gone.txt"
    assert "no repository here contains both" in describe_changes(was, now, [tmp_path])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"contents": None}, "not captured"),
        ({"base": "--output={folder}/x"}, "unknown"),
    ],
)
def test_an_incomplete_or_malicious_record_is_reported(folder, record, damage, message):
    was = record(folder)
    damage = {key: value.format(folder=folder) if key == "base" else value for key, value in damage.items()}
    assert message in describe_changes(replace(was, **damage), was, [folder] if message == "unknown" else [])
    assert not (folder / "x").exists()  # Git never got the base as an option.


def test_the_file_that_this_process_prints_to_is_no_source(folder, record):
    was = record(folder)
    with (folder / "told.txt").open("w") as file:
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            now = record(folder)
        finally:
            os.dup2(kept, 2)
            os.close(kept)
    assert now.tree == was.tree
    assert "added told.txt" in describe_changes(was, record(folder), [])
