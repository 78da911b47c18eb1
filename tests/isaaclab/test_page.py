"""The page for users of Isaac Lab describes the actual behaviour."""

import runpy
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_the_tables_are_what_the_code_has():
    maker = runpy.run_path(str(DOCS / "make_isaaclab.py"))
    made = maker["page"]()
    assert (DOCS / "tables/isaaclab_names.md").read_text(encoding="utf-8") == made, "run: python docs/make_reference.py"
    assert "|  |" not in made
    names = maker["names"]()["names"]["ArticulationData"]  # all fields of Isaac Lab's class
    assert len(names) == len(set(names)) == 129
    assert {"root_state_w", "joint_limits", "com_pos_b", "GRAVITY_VEC_W"} <= set(names)
