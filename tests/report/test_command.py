import json

from jobs.small import wheelleg

from report.runs import FIGURES, make_run
from wheelleg_exp.files import write_json, write_yaml


def test_the_path_of_the_report_is_printed(root):
    run = make_run(root)
    said = wheelleg("report", "latest", "--root", root, "--no-pictures")
    assert said.status == 0, said.err
    assert f"report: {(run.path / 'report.html').relative_to(root.parent)}" in said.out
    said = wheelleg("report", run.id, "--root", root, "--no-pictures", "--json")
    document = json.loads(said.out)
    assert document["report"] == str(run.path / "report.html")
    assert document["size"] == (run.path / "report.html").stat().st_size
    said = wheelleg("report", "nothing", "--root", root)
    assert said.status == 2
    assert "there is no run 'nothing'" in said.err


def test_an_agents_run_has_a_report(root):
    folder = root / "agents" / "stand" / "2026-03-01_10-00-00_0_zero"
    folder.mkdir(parents=True)
    write_yaml(folder / "config.yaml", {"task": {"name": "stand"}, "seed": 0, "env": {"episode_length_s": 5.0}})
    ended = {"time_out": 0, "base_contact": 8}
    write_json(folder / "figures.json", {"agent": "zero", "figures": {**FIGURES, "survival": 0.0, "ended_by": ended}})
    said = wheelleg("report", folder, "--no-pictures")
    assert said.status == 0, said.err
    html = (folder / "report.html").read_text()
    assert "No policy: the zero agent" in html
    assert "It falls in every one of 8 episodes of 5\u00a0s." in html
    assert "wheelleg play" not in html
