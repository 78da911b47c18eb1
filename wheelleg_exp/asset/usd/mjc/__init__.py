"""Lays what only MuJoCo's own USD schemas say over the robot that the other readers made.

Where the same fact stands in two schemas, MuJoCo's wins over Newton's, and Newton's over PhysX's.

| module | what it offers |
|---|---|
| `overlay` | all of it, put together |
| `options` | the scene's options, and its compiler's doing |
| `joints`, `geoms`, `equalities` | what is said of parts that exist |
| `actuators`, `tendons`, `keyframes` | parts of its own |
| `values`, `angles` | attributes as MJCF takes them |
"""

from __future__ import annotations

from wheelleg_exp.asset.usd.mjc.overlay import with_mujoco

__all__ = ["with_mujoco"]
