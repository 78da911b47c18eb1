"""Rays on the CPU onto geoms that never move: the ground's.

| module | what it offers |
|---|---|
| `still_geoms` | rays in a model of these geoms alone, where nobody has moved them |
| `reach` | which of many geoms a ray may meet, by the boxes around them |
"""
