"""Read robots from URDF.

| module | what it offers |
|---|---|
| `urdf_robot` | a description and a report from a file; degrees of freedom |
| `urdf_document` | XML elements, checked numbers, and the audit of unread elements |
| `urdf_tree` | the tree of links, with poses, axes, masses, and primitive shapes |
| `urdf_inertia`, `urdf_shapes` | mass properties and geoms of links |
| `mesh_files` | find and read mesh files |
"""
