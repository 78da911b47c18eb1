from __future__ import annotations

import pytest

from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.errors import ConfigError


def test_tasks_come_with_the_comment_on_top(stock, user):
    found = {entry.name: entry.help for entry in catalog.tasks([user])}
    assert found == {"stand": "Stand still.", "walk": "Walk along.", "hop": "Hop, in a folder of the user's own."}


def test_terms_come_with_the_first_line_of_their_targets_docstring(stock):
    found = {entry.name: (entry.target, entry.help) for entry in catalog.terms("reward")}
    assert found["alive"] == ("shelf_terms.alive", "One while the robot is up.")
    assert found["height"] == ("shelf_terms.height", "Squared distance from a height.")


def test_terms_of_all_groups_leave_out_what_is_no_term(stock):
    groups = {entry.group for entry in catalog.terms()}
    assert groups == {"action", "event", "observation", "reward", "termination"}


def test_a_term_whose_target_does_not_import_is_still_listed(stock, edit):
    edit("reward/odd.yaml", "# An odd one.\nodd:\n  _target_: shelf_terms.nothing\n  weight: 1.0\n")
    assert {e.name: e.help for e in catalog.terms("reward")}["odd"] == "An odd one."


def test_groups_and_options(stock, user):
    assert "reward" in catalog.groups()
    assert "hydra" not in catalog.groups()
    assert [entry.name for entry in catalog.options("robot")] == ["article", "physical"]
    assert "bounce" in [entry.name for entry in catalog.options("reward", [user])]


def test_an_unknown_group_is_told_with_the_nearest(stock):
    with pytest.raises(ConfigError, match="did you mean 'reward'"):
        catalog.options("rewrd")
