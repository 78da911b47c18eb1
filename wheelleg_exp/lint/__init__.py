"""Looks at the numbers of a config as an expert would before training.

| module | what it offers |
|---|---|
| `examine` | the whole look, and `RULES`, all rules by name |
| `case` | what a rule looks at |
| `anatomy/` | what its parts are for: wheels, legs, forward, mirror images |
| `robot_facts`, `collider_depth` | masses, heights and drives of the compiled robot |
| `robot/` | the compiled robot and the rules about it: overlaps, balance, symmetry, links |
| `doctor` | all of it about one robot, the most urgent first |
| `reward_tolerances` | what each reward is worth |
| `findings` | what rules find, how they are registered, and rounding |
| `rules_*` | the rules, a file for each subject |
"""
