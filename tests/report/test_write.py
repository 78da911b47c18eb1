import pytest

from report.runs import make_run
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import sha256
from wheelleg_exp.report import make_report
from wheelleg_exp.report import report_page as compile_of


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    for part in ("settings", "learning"):
        monkeypatch.setattr(f"wheelleg_exp.report.report_page.{part}", None)


def test_the_report_is_in_the_run_and_in_its_manifest(root):
    run = make_run(root)
    made = make_report(run.path, root, command=["wheelleg", "report"], pictures=False)
    assert made.path == run.path / "report.html"
    (entry,) = [e for e in run.manifest().data["additions"] if e["kind"] == "report"]
    assert entry["files"] == {"report.html": {"sha256": sha256(made.path), "size": made.size}}
    assert entry["command"] == ["wheelleg", "report"]
    assert not run.manifest().compare_files()
    manifest = (run.path / "manifest.json").read_bytes()
    make_report(run.path, root, pictures=False)
    assert (run.path / "manifest.json").read_bytes() == manifest


def test_a_run_that_has_changed_gets_a_new_report_in_place(root):
    run = make_run(root, status="running")
    before = make_report(run.path, root, pictures=False).path.read_bytes()
    run.manifest().finish("finished", {"iterations": 3})
    after = make_report(run.path, root, pictures=False).path.read_bytes()
    assert after != before
    assert not run.manifest().compare_files()


def test_a_report_outside_the_run_is_not_in_its_manifest(root, tmp_path):
    run = make_run(root)
    made = make_report(run.path, root, tmp_path / "shared" / "mine.html", pictures=False)
    assert made.path.is_file()
    assert run.manifest().data["additions"] == []
    assert not (run.path / "report.html").exists()
    run = make_run(root)
    (tmp_path / "link.html").symlink_to(tmp_path / "somewhere")
    for place in (tmp_path / "link.html", tmp_path):
        with pytest.raises(RunDirectoryError):
            make_report(run.path, root, place, pictures=False)


@pytest.mark.parametrize("content", ["notes of mine", "<html></html>", ""])
def test_another_file_and_the_report_of_another_run_are_not_overwritten(root, tmp_path, content):
    run = make_run(root)
    taken = tmp_path / "page.html"
    taken.write_text(content)
    with pytest.raises(RunDirectoryError, match="not overwritten"):
        make_report(run.path, root, taken, pictures=False)
    assert taken.read_text() == content
    with pytest.raises(RunDirectoryError, match="not overwritten"):
        make_report(run.path, root, run.iterations, pictures=False)
    shared = make_report(run.path, root, tmp_path / "shared.html", pictures=False).path
    with pytest.raises(RunDirectoryError, match="not a report of this run"):
        make_report(make_run(root).path, root, shared, pictures=False)
    make_report(run.path, root, shared, pictures=False)


def test_a_place_that_cannot_be_written_is_refused_before_the_work_starts(root, tmp_path, monkeypatch):
    run = make_run(root)
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(compile_of, "compile_page", lambda *_: pytest.fail("compiled"))
    with pytest.raises(RunDirectoryError, match=r"cannot write .*report\.html"):
        make_report(run.path, root, tmp_path / "file" / "below" / "report.html", pictures=False)
    monkeypatch.undo()
    assert list(tmp_path.glob("**/*.tmp")) == []
