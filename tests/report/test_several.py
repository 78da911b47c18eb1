import json

import numpy as np
import pytest
from jobs.small import wheelleg

from report.pages import Page
from report.runs import add_play, iteration, make_run
from wheelleg_exp.files import write_text
from wheelleg_exp.report.report_subject import Series, Subject, open_subject
from wheelleg_exp.report.several_runs_page import course, grouped, sentence
from wheelleg_exp.run.run_index import SweepIndex

# The last return of each seed, by the weight of a reward term. The means are 4 and 8; the sample standard deviations
# are 2 and sqrt(2).
RETURNS = {"1": (2.0, 4.0, 6.0), "2": (7.0, 9.0)}


@pytest.fixture
def runs(root):
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


def page_of(root, runs, *words, name="comparison.html"):
    said = wheelleg("report", *(run.path for run in runs), "--root", root, *words)
    assert said.status == 0, said.err
    return Page((root.parent / name).read_text(encoding="utf-8"))


def rows(page, section):
    inside, found = False, []
    for element in page.elements:
        if element.tag == "section" and "id" in element.attributes:
            inside = element.attributes["id"] == section
        found += [" ".join(element.text.split())] if inside and element.tag == "tr" else []
    return found


def test_settings_are_compared_with_the_spread_over_their_seeds(root, runs):
    page = page_of(root, runs)
    head, first, second = rows(page, "ended")
    assert head == "env.rewards.alive.weight runs return episode length, steps time-out survived the last play"
    assert first == "1 3 4.00 ± 2.00 60.0 ± 0.00 80.0 % ± 0 % 75 % ± 35.4 %"
    assert second.startswith("2 2 8.00 ± 1.41 ")
    told = "5 runs with 2 settings. Their returns do not compare, as env.rewards.alive.weight differs."
    assert told in " ".join(page.all("body")[0].text.split())
    assert len(rows(page, "runs")) == 6
    page = page_of(root, runs[:3], "-o", "a.html", name="a.html")
    assert len(rows(page, "ended")) == 2
    assert "3 runs with 1 setting." in page.all("body")[0].text


def subject(folder, config, scalars):
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "config.yaml").write_text(json.dumps(config))
    return Subject(folder, None, scalars={key: Series((9,), (value,)) for key, value in scalars.items()})


@pytest.mark.parametrize(
    ("configs", "time_outs", "expected"),
    [
        # The returns 1 and 3 are comparable only if both runs have equal rewards.
        (({"a": 1}, {"a": 2}), (0.5, 0.25), "The highest mean return, 3.00, is that of a=2."),
        (({"env": {"rewards": {"alive": {"weight": 1}}}}, {"env": {"rewards": {"alive": {"weight": 3}}}}), (0.5, 0.25),
         "Their returns do not compare, as env.rewards.alive.weight differs. "
         "The highest mean time-out share, 50 %, is that of weight=1."),
        (({"env": {"episode_length_s": 5}}, {"env": {"episode_length_s": 9}}), (None, None),
         "Their returns do not compare, as env.episode_length_s differs."),
        (({"agent": {"algorithm": {"gamma": 0.9}}}, {"agent": {"algorithm": {"gamma": 0.99}}}), (1.0, 1.0),
         "Their returns do not compare, as agent.algorithm.gamma differs. The mean time-out share is the same, 100 %."),
    ],
)  # fmt: skip
def test_returns_of_the_same_reward_are_ranked(tmp_path, configs, time_outs, expected):
    runs = []
    for number, (config, share) in enumerate(zip(configs, time_outs, strict=True)):
        scalars = {"Train/mean_reward": 1.0 + 2 * number}
        scalars |= {} if share is None else {"Episode_Termination/time_out": share}
        runs.append(subject(tmp_path / str(number), config, scalars))
    assert sentence(grouped(runs)) == f"2 runs with 2 settings. {expected}"


def test_trainings_without_a_time_out_are_ranked_by_the_survival_in_their_last_play(root, runs):
    found = [open_subject(run.path, root) for run in (runs[0], runs[3])]
    for subject in found:
        del subject.scalars["Episode_Termination/time_out"]
    assert "survival" not in sentence(grouped(found))  # One of the runs was never played.
    add_play(runs[3], survival=0.75)
    found[1].manifest = runs[3].manifest().facts
    assert sentence(grouped(found)).endswith("The highest mean survival in the last plays, 75 %, is that of weight=2.")


def test_curves_are_overlaid(root, runs, drawings_too):
    page = page_of(root, runs)
    assert len(page.all("figcaption")) == 3
    texts = ["".join(drawing.itertext()) for drawing in page.drawings]
    assert ["weight=2" in text for text in texts] == [True] * 3  # Each of three legends contains the group.


def test_a_curve_is_the_mean_and_deviation_where_all_runs_have_a_value():
    runs = [([0, 1, 2, 3], [1.0, 2.0, float("nan"), 4.0]), ([0, 2, 3], [3.0, 5.0, 4.0]), ([], [])]
    at, mean, deviation = course(runs)
    np.testing.assert_array_equal(at, [0, 3])
    np.testing.assert_allclose(mean, [2.0, 4.0])
    np.testing.assert_allclose(deviation, [np.sqrt(2), 0.0])
    assert [len(part) for part in course([])] == [0, 0, 0]
    at, mean, deviation = course([(range(1499), [1.0] * 1499), (range(1500), [3.0] * 1500)])
    assert len(at) <= 800
    assert at[-1] == 1498
    np.testing.assert_allclose(mean, 2.0)
    np.testing.assert_allclose(deviation, np.sqrt(2))


def test_a_sweeps_report_is_in_its_folder(root, runs):
    jobs = [([f"seed={i}"], [f"seed={i}"]) for i in range(6)]
    index = SweepIndex.create(root, command=[], launcher={"name": "basic", "at_once": 1}, jobs=jobs)
    for number, run in enumerate(runs, 1):
        index.update(number, run=index.relative(run.path))  # The sixth job has not started.
    said = wheelleg("report", index.folder.name, "--root", root, "--json")
    assert json.loads(said.out)["report"] == str(index.folder / "report.html")
    assert len(rows(Page((index.folder / "report.html").read_text(encoding="utf-8")), "runs")) == 6
    assert wheelleg("report", index.folder, "--root", root).status == 0  # The second report replaces the first report.


def test_a_single_seed_and_unequal_lengths_are_mentioned(root, runs):
    make_run(root, ["seed=9", "env.rewards.alive.weight=3"], name="short", iterations=1)
    text = page_of(root, runs, sorted(root.glob("stand/*short"))[0]).section("ended")
    assert "One setting has a single run" in text
    assert "They were trained for 1 to 3 iterations." in text


def test_another_file_is_not_overwritten_and_a_sweep_without_runs_has_no_report(root, runs):
    (root.parent / "comparison.html").write_text("my notes")
    index = SweepIndex.create(
        root, command=[], launcher={"name": "basic", "at_once": 1}, jobs=[(["seed=1"], ["seed=1"])]
    )
    for paths, expected in (([runs[0].path, runs[1].path], "not overwritten"), ([index.folder], "has no run yet")):
        said = wheelleg("report", *paths, "--root", root)
        assert (said.status, expected in said.err) == (2, True)
