import pytest

from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.errors import ConfigError


def test_tasks_have_the_comment_at_the_top_of_their_file(stock, user):
    found = {entry.name: entry.help for entry in catalog.options("task", [user])}
    assert found == {"stand": "Stand still.", "walk": "Walk along.", "hop": "Hop, in a folder of the user's own."}


def test_terms_have_the_first_line_of_their_targets_docstring_or_the_comment_of_their_file(stock, edit):
    edit("reward/odd.yaml", "# An odd one.\nodd:\n  _target_: shelf_terms.nothing\n  weight: 1.0\n")
    found = {entry.name: (entry.target, entry.help) for entry in catalog.terms("reward")}
    assert found["alive"] == ("shelf_terms.alive", "One while the robot is up.")
    assert found["height"] == ("shelf_terms.height", "Squared distance from a height.")
    assert found["odd"][1] == "An odd one."  # The target cannot be imported.


def test_lists_of_terms_contain_only_terms(stock):
    groups = {entry.group for entry in catalog.terms()}
    assert groups == {"action", "event", "observation", "reward", "termination"}


def test_groups_and_options_are_listed_and_an_unknown_group_is_refused(stock, user):
    assert "reward" in catalog.groups()
    assert "hydra" not in catalog.groups()
    assert [entry.name for entry in catalog.options("robot")] == ["article", "physical"]
    assert "bounce" in [entry.name for entry in catalog.options("reward", [user])]
    with pytest.raises(ConfigError, match="did you mean 'reward'"):
        catalog.options("rewrd")
