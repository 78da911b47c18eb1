"""Read robots from URDF: by MuJoCo's own reader, and by the XML for data that MuJoCo ignores.

| module | what it offers |
|---|---|
| `urdf_robot` | a description and a report from a file; degrees of freedom |
| `urdf_document` | XML elements, checked numbers, and the audit of unread elements |
| `urdf_tree` | the tree of links, and MuJoCo's reading of them |
| `urdf_inertia`, `urdf_shapes` | mass properties and geoms of links |
| `mesh_files` | find and read mesh files |
"""
