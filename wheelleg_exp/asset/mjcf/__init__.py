"""Write a robot description as MJCF, and compare the compiled model with the robot description.

| module | what it offers |
|---|---|
| `mjcf_document` | the whole file: settings, body tree, meshes, keyframes, assumptions as comments |
| `default_classes` | default classes, named by the role of joints |
| `mjcf_elements` | an XML tree that prints the same bytes each time; attributes of elements |
| `compile_mjcf` | the compiled model: comparison with the description, force gains |
| `coupled_positions` | positions of joints that follow other joints |
| `preview_scene` | floor and light for viewing a robot |
"""
