"""Reads robots from URDF: MuJoCo's own reader for what it reads, the XML for what it passes over in silence.

| module | what it offers |
|---|---|
| `robot` | a file becomes a description and a report |
| `xml`, `document` | elements, numbers and what was read |
| `mujoco_reader` | what MuJoCo's reader sees |
| `kinematics`, `joints` | the tree, and its degrees of freedom |
| `inertia`, `shapes` | what links weigh, and how they look |
| `files`, `meshes`, `collada` | the files that a URDF names |
| `audit` | what nothing was made of |
"""
