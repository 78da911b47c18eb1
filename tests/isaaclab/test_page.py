"""The page for people who come from Isaac Lab says what is so."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
HELD = ("ArticulationData", "ManagerBasedRLEnv", "RewardManager", "TerminationManager", "CommandManager", "utils.math")


@pytest.fixture(scope="module")
def maker():
    spec = importlib.util.spec_from_file_location("make_isaaclab", DOCS / "make_isaaclab.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sections(text):
    """Return the tables of the page by their headings."""
    return dict(re.findall(r"^### `([\w.]+)`: (.*?)(?=^### |\Z)", text, flags=re.M | re.S))


def test_the_tables_are_what_the_code_has(maker):
    page, made = (sections(text) for text in ((DOCS / "isaaclab.md").read_text(encoding="utf-8"), maker.tables()))
    for name in HELD:
        assert page[name].strip() == made[name].strip()
        assert "|  |" not in made[name]  # whatever is absent says why


def test_all_of_isaac_labs_data_is_named(maker):
    listed = maker.names()["names"]
    assert len(listed["ArticulationData"]) == len(set(listed["ArticulationData"])) == 129
    assert {"root_state_w", "joint_limits", "com_pos_b", "GRAVITY_VEC_W"} <= set(listed["ArticulationData"])
