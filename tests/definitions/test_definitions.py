"""Definitions of figures: they are of what the program computes, and each label says one thing in its table."""

from dataclasses import fields

import pytest

from wheelleg_exp import definitions
from wheelleg_exp.definitions import ending, percent, share
from wheelleg_exp.inspection.episode_measures import EffortUse, ForceExtreme, RewardShare, TrackingError
from wheelleg_exp.inspection.recorded_numbers import Statistics
from wheelleg_exp.inspection.recording_summary import EpisodeFigures, Sample, Trend

MADE = {
    "samples": Sample,
    "episodes": EpisodeFigures,
    "base": Statistics,
    "tracking": TrackingError,
    "contact forces": ForceExtreme,
    "efforts": EffortUse,
    "rewards": RewardShare,
    "training": Trend,
}
TABLES = {
    **definitions.RECORDED,
    "play": {**definitions.ROLLOUT, **definitions.MOTION},
    "contacts": definitions.CONTACTS,
    "scalars": definitions.SCALARS,
}


@pytest.mark.parametrize("table", MADE)
def test_a_table_s_figures_are_those_that_are_computed(table):
    made = {field.name for field in fields(MADE[table])} | {"iterations"}
    assert set(definitions.RECORDED[table]) <= made


@pytest.mark.parametrize("table", TABLES)
def test_labels_of_a_table_are_unique(table):
    labels = [found.label for found in TABLES[table].values()]
    assert len(set(labels)) == len(labels)
    assert all(found.meaning.endswith(".") for found in TABLES[table].values())


@pytest.mark.parametrize(
    ("key", "label", "unit"),
    [
        ("Train/mean_reward", "return, mean", ""),
        ("Episode_Termination/base_contact", "last episode ended by base_contact", "share"),
        ("Episode_Metrics/drive/error_vel_xy_per_step", "mean planar velocity error (drive)", "m/s"),
        ("Episode_Metrics/arm/reach_per_step", "mean reach (arm)", ""),
        ("Metrics_per_step/drive/error_vel_xy", "planar velocity error (drive)", "m/s"),
        ("Rewards_per_step/alive", "alive, reward per second", "1/s"),
        ("Metrics/drive/error_vel_xy", "error_vel_xy, added up over an episode (drive)", ""),
        ("Curriculum/terrain/level", "curriculum terrain/level", ""),
        ("Diagnostics/feet_overflow", "more contacts than feet sums", "share"),
        ("Loss/rnd", "rnd loss", ""),
    ],
)
def test_a_scalar_s_label_has_the_names_of_its_key(key, label, unit):
    found = definitions.scalar_definition(key)
    assert found is not None
    assert (found.label, found.unit) == (label, unit)


def test_a_scalar_of_another_program_has_no_definition():
    assert definitions.scalar_definition("rollout/ep_rew_mean") is None


def test_what_height_and_pitch_leave_out_stands_in_their_labels():
    assert definitions.rollout_label("pitch_rms_deg", 1.0) == "pitch, RMS, after 1 s"
    assert definitions.rollout_label("pitch_rms_deg", 0.0) == "pitch, RMS, from the start"
    assert (
        definitions.rollout_label("mean_return", 1.0) == definitions.rollout_label("mean_return", 0.0) == "return, mean"
    )


def test_a_share_of_few_episodes_shows_their_number():
    assert (share(1, 1), share(0, 3), share(0, 0)) == ("100.0% (1 of 1)", "0.0% (0 of 3)", "-")


@pytest.mark.parametrize(
    ("value", "shown"), [(1.0, "100.0%"), (0.9999, "99.9%"), (0.0001, "0.1%"), (0.0, "0.0%"), (0.938, "93.8%")]
)
def test_nearly_all_is_not_all(value, shown):
    assert percent(value) == shown


def test_an_episode_ends_by_all_that_fired_or_by_a_reward():
    assert ending(["a", "b"]) == "a and b"
    assert ending([]) == "a number that is not finite"
