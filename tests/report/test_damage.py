import shutil

import pytest

from report.pages import Page
from report.runs import FIGURES, add_play, make_run
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import write_text
from wheelleg_exp.report.pictures_section import Look
from wheelleg_exp.report.provenance_section import Verdict
from wheelleg_exp.report.report_page import compile_page, render_page
from wheelleg_exp.report.report_subject import open_subject
from wheelleg_exp.run.records import RunRecord, read_record

pytestmark = pytest.mark.slow


@pytest.fixture
def run(root):
    run = make_run(root)
    add_play(run)
    return run


def test_broken_lines_of_the_log_are_skipped_and_without_a_log_there_are_no_curves(page, run):
    run.iterations.write_text(run.iterations.read_text() + '{"iteration": 3, "sca')
    found = page(run)
    assert "1 of the lines of iterations.jsonl cannot be read" in found.text
    assert "Return, mean of the last 100 ended episodes" in found.section("learning")
    run.iterations.unlink()
    found = page(run)
    assert "no learning curves" in found.section("learning")
    assert "iterations.jsonl is missing" in found.section("trust")
    assert "Survival 75 %" in found.text


@pytest.mark.parametrize("content", [b"", b"\x00\xff", b"[1, 2", b"- 1\n", b"a: !!python/object:os.system x\n"])
def test_damaged_parameters_are_reported(page, run, content):
    (run.params / "env.yaml").write_bytes(content)
    found = page(run)
    assert "env.yaml" in found.text
    assert "rewards of this task are not known" in found.section("objective")
    assert "Survival 75 %" in found.text


@pytest.mark.parametrize("content", ["hydra: 1\n", "hydra: {runtime: {choices: {}, config_sources: none}}\n"])
def test_a_hydra_file_without_choices_or_config_folders_is_reported(page, run, content):
    assert "hydra.yaml lacks" not in page(run).text
    write_text(run.hydra / "hydra.yaml", content)
    found = page(run)
    assert "the file .hydra/hydra.yaml lacks the choices or the config folders of the run" in found.text
    assert "Survival 75 %" in found.text


def test_without_hydra_source_and_asset_the_other_sections_exist(page, run):
    for folder in (run.hydra, run.source, run.asset):
        shutil.rmtree(folder)
    found = page(run)
    assert "were not recorded" in found.section("settings")
    assert "Return, mean of the last 100 ended episodes" in found.section("learning")
    write_text(run.environment, "numpy==3\n")
    found = page(run)
    assert "was not recorded" in found.section("learning")
    assert "Reproducibility Damaged" in found.text
    assert "environment.txt was changed" in found.section("trust")


@pytest.mark.parametrize("content", [b"", b"no recording", b"RRF2\x00\x00"])
def test_a_damaged_recording_is_reported_in_its_section(page, run, content):
    run.recording.write_bytes(content)
    text = page(run).section("learning")
    for expected in ("recording", "cannot be shown", "Return, mean of the last 100 ended episodes"):
        assert expected in text


@pytest.mark.parametrize(("number", "value"), enumerate([None, 1, "x", [1], ["x"], {"a": 1}, [{"a": 1}], 1e400]))
def test_there_is_a_page_for_every_content_of_a_manifest(run, monkeypatch, number, value):
    for part in ("settings", "learning"):
        monkeypatch.setattr(f"wheelleg_exp.report.report_page.{part}", None)
    whole = run.manifest().data
    kept = {"format", "status", "started", "files"}  # A manifest must have these keys.
    changes = [{key: value} for key in sorted(whole.keys() - kept)]
    play = {"kind": "play", "files": {}}
    changes += [{"additions": [{**play, "results": {**FIGURES, key: value}}]} for key in FIGURES]
    for change in changes[number % 2 :: 2]:
        subject = open_subject(run.path, run.root)
        try:
            subject.manifest = read_record(RunRecord, {**whole, **change}, "broken manifest", run.path)
        except RunDirectoryError:
            continue
        html = render_page(compile_page(subject, Look(subject, pictures=False), Verdict(None, None, [], subject)))
        assert Page(html).wrong == []
