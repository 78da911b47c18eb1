from __future__ import annotations

from dataclasses import fields, replace

import pytest

from wheelleg_exp.cli.printing.metric_tables import print_contacts, print_evaluation, print_figures
from wheelleg_exp.definitions import CONTACTS, ROLLOUT
from wheelleg_exp.jobs.rollout_figures import ContactFigures, MotionFigures, StandFigures

EPISODES = {"episodes": 8, "unfinished": 1, "survival": 6 / 7, "settled_episodes": 6, "settled_steps": 1440}
POSE = {"height_rmse_m": 0.0021, "height_mean_m": 0.072, "pitch_rms_deg": 1.1, "pitch_mean_deg": 0.9}
ENDED = {"time_out": 6, "base_contact": 0, "leg_contact": 0, "base_contact and leg_contact": 1}
PLAYED = StandFigures(**EPISODES, **POSE, settle_s=1.0, mean_return=24.6, ended_by=ENDED)


@pytest.fixture
def printed(capsys):
    def table(figures: StandFigures, motion: MotionFigures | None = None) -> dict[str, str]:
        print_figures(figures, motion)
        lines = capsys.readouterr().out.splitlines()
        at = lines[0].index("value")
        return {line[:at].strip(): " ".join(line[at:].split()) for line in lines[1:]}

    return table


def test_each_figure_names_its_sample(printed):
    found = printed(PLAYED)
    assert (found["episodes"], found["still running"]) == ("8 the first of each environment", "1")
    assert found["survived to the time-out"] == "85.7% 7 ended episodes"
    assert found["base height, RMSE to target, after 1 s"] == "2.10 mm 1440 steps of 6 episodes"
    assert found["pitch, mean, after 1 s"] == "0.90 deg 1440 steps of 6 episodes"
    assert found["return, mean"] == "24.60 7 ended episodes"
    assert sum(int(value) for label, value in found.items() if label.startswith("ended by ")) == PLAYED.ended


def test_motion_is_printed_with_its_unit_and_by_group(printed):
    motion = MotionFigures(0.0123, 1.5, 0.75, 0.25, {"wheels": 0.01}, {"wheels": 0.0004}, {"wheels": 2.0})
    found = printed(PLAYED, motion)
    assert found["strayed from its place, after 1 s"] == "12.3 mm 6 episodes"
    assert found["actions change, after 1 s"] == "0.75 /s 1440 steps of 6 episodes"
    assert found["torque, RMS, after 1 s (wheels)"] == "0.0100 N·m 1440 steps of 6 episodes"
    assert found["at the effort limit, after 1 s (wheels)"].startswith("0.1%")
    assert found["torque changes its sign, after 1 s (wheels)"].startswith("2.0 /s")
    none = MotionFigures(None, None, None, None, {}, {}, {})
    assert printed(PLAYED, none)["power, net of armature, after 1 s"].startswith("- ")


def test_figures_after_another_settling_time_have_another_label(printed):
    play, agent = printed(PLAYED), printed(replace(PLAYED, settle_s=0.0))
    apart = {label for label in play if label.startswith(("base height", "pitch"))}
    assert len(apart) == 4
    assert not apart & set(agent)
    assert set(play) - apart == {label for label in agent if not label.endswith("from the start")}


def test_figures_without_ended_or_settled_episodes_are_dashes(printed):
    nan = float("nan")
    none = replace(PLAYED, unfinished=8, survival=None, mean_return=None, settled_episodes=0, settled_steps=0)
    found = printed(replace(none, height_rmse_m=nan, height_mean_m=nan, pitch_rms_deg=nan, pitch_mean_deg=nan))
    assert found["survived to the time-out"] == "- 0 ended episodes"
    assert found["base height, mean, after 1 s"] == "- no episode lasted that long"


def test_contacts_name_their_steps(capsys):
    print_contacts("feet", [ContactFigures("wheel", 2.0, 4.0, 0.5, 120)])
    *words, columns, _ = capsys.readouterr().out.strip().splitlines()
    title = " ".join(words)
    assert "at the end of a step, over 120 steps of all episodes and environments" in title
    assert "at least 0.2 s after a reset and with a tilt below 0.2 rad" in title
    assert columns.split("  ")[0] == "link"
    assert "largest (N)" in columns


def test_every_key_has_a_definition():
    assert {field.name for field in fields(StandFigures)} == set(ROLLOUT)
    assert {field.name for field in fields(ContactFigures)} - {"body"} == set(CONTACTS)


def test_a_metric_whose_episodes_agree_has_no_interval(capsys):
    ends = {"survival": (1.0, 1.0, 1.0), "drift": (0.5, 0.25, 0.50001), "speed": (0.0, None, None)}
    metrics = {
        f"stand/{name}": {**dict(zip(("value", "low", "high"), found, strict=True)), "unit": "m", "episodes": 8}
        for name, found in ends.items()
    }
    facts = {"about": {"physics_dt_s": 0.005, "step_dt_s": 0.02}, "protocol": {"name": "stand"}, "seed": 1}
    print_evaluation({**facts, "scenarios_sha256": "c" * 64, "metrics": metrics})
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[-3:]]
    assert rows == [
        ["survival", "1", "m", "8"],
        ["drift", "0.5", "0.25", "to", "0.5", "m", "8"],
        ["speed", "0", "-", "m", "8"],
    ]
