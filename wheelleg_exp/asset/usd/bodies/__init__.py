"""Find the bodies of a USD stage, connect them as trees, and compute their mass properties.

| module | what it offers |
|---|---|
| `rigid_bodies` | the bodies, the body of a prim, saved velocities |
| `roots`, `body_tree` | roots of trees, the trees, joints that close loops |
| `mass` | mass properties as PhysX computes them |
"""
