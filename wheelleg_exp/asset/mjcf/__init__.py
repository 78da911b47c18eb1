"""Writes a robot description as MJCF, and holds the compiled model against it.

| module | what it offers |
|---|---|
| `document` | the whole file, meshes and keyframes included |
| `bodies` | the tree of bodies |
| `classes`, `roles` | default classes, so that a number stands once, called after what joints are for |
| `attributes` | what an element says of itself |
| `notes` | assumptions as comments |
| `acceleration_drives` | gains of acceleration as gains of force |
| `verify` | the written file against the description |
| `refused` | which of a file's MuJoCo attributes MuJoCo does not take |
| `scene` | floor and light to look at a robot in |
| `xml` | an XML tree of the same bytes each time |
"""
