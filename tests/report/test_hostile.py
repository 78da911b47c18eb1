import json

import pytest

from report.pages import Page
from report.runs import FIGURES, change_manifest, iteration, make_run
from wheelleg_exp.files import write_json, write_text, write_yaml
from wheelleg_exp.report import make_report

pytestmark = pytest.mark.slow

EVIL = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{ 7 * 7 }}</style></title>"


@pytest.fixture
def evil(root):
    run = make_run(root, ["agent.max_iterations=3"])
    rewards = {EVIL: {"_target_": EVIL, "weight": EVIL, EVIL: EVIL}, "alive": {"weight": 1.0}}
    env = {"robot": {"asset": EVIL, "profile": EVIL}, "rewards": rewards, "terminations": {EVIL: {"time_out": True}}}
    write_yaml(run.params / "env.yaml", {**env, EVIL: EVIL})
    write_text(run.hydra / "overrides.yaml", json.dumps([EVIL, f"{EVIL}={EVIL}"]))
    hydra = {"hydra": {"runtime": {"choices": {"task": "stand", EVIL: EVIL}, "config_sources": [{"path": EVIL}]}}}
    write_yaml(run.hydra / "hydra.yaml", hydra)
    other = {"format": 1, "status": EVIL, "branch": EVIL, "remote": {EVIL: EVIL}, "note": EVIL, "root": EVIL}
    refused = [{"path": EVIL, "reason": EVIL}]
    write_json(run.source / "git.json", {**other, "untracked": [EVIL], "refused": refused, "others": [other]})
    findings = [{"path": EVIL, "name": EVIL, EVIL: EVIL}]
    found = {"warnings": findings, "assumptions": findings, "left_out": findings}
    write_json(run.asset / "report.json", {"source": EVIL, "totals": {EVIL: EVIL}, **found})
    line = iteration(0)
    line["scalars"] |= {f"Episode_Termination/{EVIL}": 0.5, f"Episode_Reward/{EVIL}": 2.0, f"Metrics/{EVIL}": 1.0}
    write_text(run.iterations, json.dumps(line) + "\n")
    results = {**FIGURES, "checkpoint": EVIL, "overrides": [EVIL], "ended_by": {EVIL: 8}, EVIL: EVIL}
    addition = {"when": "2026-03-01T10:00:00.000000Z", "command": [EVIL], "files": {}, "results": results}
    change_manifest(
        run,
        **dict.fromkeys(("id", "task", "replay_of"), EVIL),
        **{key: {EVIL: EVIL} for key in ("versions", "threads", "environment_variables")},
        **{"command": [EVIL, EVIL], "error": {"type": EVIL, "message": EVIL}},
        **{"hardware": {"cpu": EVIL, "cores": EVIL, "platform": EVIL}, "process": {"host": EVIL}},
        results={"iterations": EVIL, EVIL: EVIL},
        resumes=[{"when": EVIL, "overrides": [EVIL], "iteration": 1, "before": {"status": EVIL}}],
        additions=[{"kind": kind, **addition} for kind in ("play", "play", "evaluation", EVIL)],
    )
    return run


def test_nothing_in_a_run_becomes_markup(evil, root):
    found = Page(make_report(evil.path, root, pictures=False).path.read_text())
    assert (found.wrong, found.all("img"), found.all("script", "title")[0].tag) == ([], [], "title")
    assert len(found.all("title")) == 1
    assert not [e for e in found.elements for name in e.attributes if name.startswith("on")]
    assert found.text.count("<script>alert(1)</script>") > 20
    assert "{{ 7 * 7 }}" in found.text
    assert "49" not in found.section("objective")


@pytest.mark.usefixtures("drawings_too")
def test_names_in_drawings_stay_text_as_well(evil, root):
    found = Page(make_report(evil.path, root, pictures=False).path.read_text())
    elements = [element for drawing in found.drawings for element in drawing.iter()]
    assert [e for e in elements if e.tag.endswith("}text") and "<script>" in "".join(e.itertext())]
    assert [e for e in elements if e.tag.endswith("script")] == []
    assert (found.all("script"), found.wrong) == ([], [])


def test_a_folder_with_such_a_name_is_reported_and_its_report_is_written_again(root):
    run = make_run(root)
    moved = run.path.with_name('<img src=x onerror=alert(1)>"')
    run.path.rename(moved)
    for _ in range(2):
        found = Page(make_report(moved, root, pictures=False).path.read_text())
        assert (found.all("img"), found.all("h1")[0].text) == ([], "stand")


def test_characters_that_hide_text_are_shown(page, root):
    run = make_run(root, status="failed", error=RuntimeError("safe\u202egnp.exe\x00\x1b[31m"))
    text = page(run).text
    assert "\u202e" not in text
    assert "\\u202e" in text
    assert "\\x00\\x1b[31m" in text


def test_a_link_out_of_the_run_is_not_read(page, root, tmp_path):
    secret = tmp_path / "secret.yaml"
    secret.write_text("password: hunter2\n")
    run = make_run(root)
    (run.params / "env.yaml").unlink()
    (run.params / "env.yaml").symlink_to(secret)
    assert "hunter2" not in page(run).text


def test_interpolations_of_the_run_read_nothing_of_this_machine(page, root, monkeypatch):
    monkeypatch.setenv("WHEELLEG_SECRET", "hunter2")
    run = make_run(root)
    write_yaml(run.params / "agent.yaml", {"experiment": "${oc.env:WHEELLEG_SECRET}"})
    write_text(run.hydra / "overrides.yaml", '["run.name=${oc.env:WHEELLEG_SECRET}"]')
    text = page(run).text
    assert "hunter2" not in text
    assert "${oc.env:WHEELLEG_SECRET}" in text
