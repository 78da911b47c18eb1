"""A compiled robot as an expert looks at it: overlaps, balance, symmetry, links, and what its conversion lost.

| module | what it offers |
|---|---|
| `compiled` | the robot's model, pose, anatomy, facts and conversion report together |
| `from_file` | the same of a robot's file alone, without a task |
| `overlaps`, `balancing` | bodies inside one another; the pose that balances |
| `rules_*` | the rules, a file for each subject |
"""
