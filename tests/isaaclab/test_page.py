"""The page for users of Isaac Lab describes the actual behaviour."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def maker():
    spec = importlib.util.spec_from_file_location("make_isaaclab", DOCS / "make_isaaclab.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_what_the_code_has(maker):
    made = maker.page()
    assert (DOCS / "isaaclab_names.md").read_text(encoding="utf-8") == made, "run: python docs/make_reference.py"
    assert "|  |" not in made


def test_all_of_isaac_labs_data_is_named(maker):
    listed = maker.names()["names"]
    assert len(listed["ArticulationData"]) == len(set(listed["ArticulationData"])) == 129
    assert {"root_state_w", "joint_limits", "com_pos_b", "GRAVITY_VEC_W"} <= set(listed["ArticulationData"])
