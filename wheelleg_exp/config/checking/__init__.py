"""Every mistake in a config that can be found without simulating, all at once.

| module | what it offers |
|---|---|
| `collect` | all of them, those included that Hydra would stop at |
| `check` | those of a composed config; a `check_*` each for agent, terms, robot, links, mounts and Hydra's keys |
| `diagnose`, `diagnose_groups` | what Hydra raises, as errors for people |
| `robot_names` | joints and bodies of the robot's file |
"""
