"""Read robots from USD.

| module | what it offers |
|---|---|
| `usd_robot` | a description and a report from a file |
| `usd_layers`, `usd_stage` | layers, variants, units, prims, and the physics scene |
| `ledger`, `audit` | record what was read, and name what was not |
| `bodies`, `joints` | bodies and joints of UsdPhysics and PhysX |
| `gprims`, `colliders`, `usd_geoms`, `materials` | shapes, sites, and filters of UsdPhysics and PhysX |
| `mjc_parts`, `mjc_overlay` | data of MuJoCo's own schemas |
"""
