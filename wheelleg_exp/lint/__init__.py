"""Check the numbers of a config as an expert would before training.

| module | what it offers |
|---|---|
| `rule` | the case that a rule inspects, findings, the registry of rules, rounding |
| `physics_check` | the report of ``check --physics``, and `RULES`, all rules by name |
| `diagnosis` | the report of ``doctor`` about one robot, the most urgent finding first |
| `reward_tolerances` | the value of each reward |
| `rules_*` | the rules, a file for each subject |
"""
