"""``wheelleg report`` of several runs and of sweeps: settings, and the spread over seeds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from jobs.small import wheelleg

from report.pages import Page
from report.runs import add_play, iteration, make_run
from wheelleg_exp.files import write_text
from wheelleg_exp.report.which_is_better import course
from wheelleg_exp.run.sweep_index import SweepIndex

# By weight of a reward: the last return of each seed. Mean 4 and 8; standard deviation of a sample 2 and sqrt(2).
RETURNS = {"1": (2.0, 4.0, 6.0), "2": (7.0, 9.0)}


@pytest.fixture
def runs(root):
    """Five runs: three seeds of one setting, two of another."""
    found = []
    for weight, returns in RETURNS.items():
        for seed, value in enumerate(returns):
            words = [f"seed={seed}", f"env.rewards.alive.weight={weight}", f"run.name=n{seed}"]
            run = make_run(root, words, name=f"w{weight}_{seed}")
            lines = [iteration(index) for index in range(3)]
            lines[-1]["scalars"]["Train/mean_reward"] = value
            write_text(run.iterations, "".join(json.dumps(line) + "\n" for line in lines))
            found.append(run)
    add_play(found[0], survival=0.5)
    add_play(found[1], survival=1.0)
    return found


def page_of(*words):
    said = wheelleg("report", *words)
    assert said.status == 0, said.err
    return said


def rows(page, section):
    """Return the texts of the rows of a section's table."""
    inside, found = False, []
    for element in page.elements:
        if element.tag == "section" and "id" in element.attributes:
            inside = element.attributes["id"] == section
        if inside and element.tag == "tr":
            found.append(" ".join(element.text.split()))
    return found


def test_settings_are_compared_with_the_spread_over_their_seeds(root, runs):
    page_of(*(run.path for run in runs), "--root", root)
    page = Page((root.parent / "comparison.html").read_text(encoding="utf-8"))
    head, first, second = rows(page, "ended")
    assert head == "env.rewards.alive.weight runs return episode length, steps time-out survived the last play"
    assert first == "1 3 4.00 ± 2.00 60.0 ± 0.00 80.0 % ± 0 % 75 % ± 35.4 %"
    assert second.startswith("2 2 8.00 ± 1.41 ")
    assert "5 runs with 2 settings. The highest mean return, 8.00, is that of weight=2." in " ".join(
        page.all("body")[0].text.split()
    )
    assert len(rows(page, "runs")) == 6


def test_names_and_seeds_alone_make_no_other_setting(root, runs):
    page_of(*(run.path for run in runs[:3]), "--root", root, "-o", "a.html")
    page = Page((root.parent / "a.html").read_text(encoding="utf-8"))
    assert len(rows(page, "ended")) == 2
    assert "3 runs with 1 setting." in page.all("body")[0].text


def test_curves_are_overlaid(root, runs, drawings_too):
    page_of(*(run.path for run in runs), "--root", root)
    page = Page((root.parent / "comparison.html").read_text(encoding="utf-8"))
    assert len(page.all("figcaption")) == 3
    assert page.section("learned").count("weight=2") == 3  # in the legend of each of three drawings


def test_a_curve_is_the_mean_and_deviation_of_the_runs_that_have_a_value():
    at, mean, deviation = course([([0, 1, 2], [1.0, 2.0, float("nan")]), ([0, 2], [3.0, 5.0])])
    np.testing.assert_array_equal(at, [0, 1, 2])
    np.testing.assert_allclose(mean, [2.0, 2.0, 5.0])
    np.testing.assert_allclose(deviation, [np.sqrt(2), 0.0, 0.0])


def test_a_sweeps_report_stands_in_its_folder(root, runs):
    jobs = [([f"seed={i}"], [f"seed={i}"]) for i in range(6)]
    index = SweepIndex.create(root, command=[], launcher={}, jobs=jobs)
    for number, run in enumerate(runs, 1):
        index.job_has_run(number, run.path)  # the sixth has not begun
    said = json.loads(page_of(index.folder.name, "--root", root, "--json").out)
    assert said["report"] == str(index.folder / "report.html")
    assert len(rows(Page((index.folder / "report.html").read_text(encoding="utf-8")), "runs")) == 6
    page_of(index.folder, "--root", root)  # and again, over the earlier one


def test_a_single_seed_and_unequal_lengths_are_said(root, runs):
    make_run(root, ["seed=9", "env.rewards.alive.weight=3"], name="short", iterations=1)
    page_of(*(run.path for run in runs), sorted(root.glob("stand/*short"))[0], "--root", root)
    text = " ".join(Page((root.parent / "comparison.html").read_text(encoding="utf-8")).section("ended").split())
    assert "One setting has a single run" in text
    assert "They were trained for 1 to 3 iterations." in text


def test_something_else_is_not_overwritten(root, runs):
    (root.parent / "comparison.html").write_text("my notes")
    said = wheelleg("report", runs[0].path, runs[1].path, "--root", root)
    assert said.status == 2
    assert "not overwritten" in said.err


def test_an_empty_sweep_is_told(root):
    root.mkdir(exist_ok=True)
    index = SweepIndex.create(root, command=[], launcher={}, jobs=[(["seed=1"], ["seed=1"])])
    said = wheelleg("report", index.folder, "--root", root)
    assert said.status == 2
    assert "has no run yet" in said.err
