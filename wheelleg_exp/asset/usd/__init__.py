"""Reads USD into a robot description.

| module | what it offers |
|---|---|
| `robot` | a file becomes a description and a report |
| `layers`, `missing_layers`, `variants`, `stage` | the file, opened with care |
| `precision` | numbers as short as the file's precision allows |
| `ledger`, `audit`, `reasons` | what was read, and what nobody read |
| `bodies`, `joints`, `shapes` | UsdPhysics and PhysX, by subject |
| `mjc` | what only MuJoCo's schemas say |
| `attributes`, `units`, `scene` | values in SI units, and gravity |
| `summary` | the report |
"""
