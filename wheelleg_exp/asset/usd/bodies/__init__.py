"""Finds the bodies of a stage, makes trees of them, and says what they weigh.

| module | what it offers |
|---|---|
| `rigid_bodies` | the bodies, and whose a prim is |
| `roots`, `nodes`, `tree` | where trees start, and how they grow |
| `loops` | joints that close loops |
| `mass`, `collider_mass` | mass properties as PhysX computes them |
| `velocity` | saved velocities |
"""
