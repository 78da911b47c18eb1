"""Turns gprims into geoms and sites, and says which of them never touch.

| module | what it offers |
|---|---|
| `colliders` | what collides, and what is only drawn |
| `gprims`, `geoms` | MuJoCo's shapes for USD's, and their names |
| `instancer` | where copies stand |
| `materials` | colours and friction |
| `collision_filters` | pairs, groups and articulations that never touch |
| `sites` | named frames |
"""
