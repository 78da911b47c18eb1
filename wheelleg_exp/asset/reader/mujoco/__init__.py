"""Lays what only MuJoCo's own USD schemas say over the robot that the other readers made.

Where the same fact stands in two schemas, MuJoCo's wins over Newton's, and Newton's over PhysX's.
"""

from __future__ import annotations

from wheelleg_exp.asset.reader.mujoco.overlay import with_mujoco

__all__ = ["with_mujoco"]
