"""Writes a robot description as MJCF, and holds the compiled model against it.

| module | what it offers |
|---|---|
| `document` | the whole file, meshes and keyframes included |
| `bodies` | the tree of bodies |
| `classes` | default classes, so that a number stands once |
| `attributes` | what an element says of itself |
| `notes` | assumptions as comments |
| `acceleration_drives` | gains of acceleration as gains of force |
| `verify` | the written file against the description |
| `xml` | an XML tree of the same bytes each time |
"""
