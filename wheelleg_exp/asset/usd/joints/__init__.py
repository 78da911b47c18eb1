"""Turns the joints of a stage into degrees of freedom, tendons and couplings.

| module | what it offers |
|---|---|
| `joints` | which bodies a joint joins, and where |
| `axes` | which axes it leaves free |
| `articulate` | its degrees of freedom, put together |
| `limits`, `drives`, `passive` | range, drive, friction and bounds of one axis |
| `distance`, `mimic` | joints that become tendons and couplings |
"""
