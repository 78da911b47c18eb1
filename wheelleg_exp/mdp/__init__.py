"""The library of predefined manager terms, which task configs in YAML select.

| module | what it offers |
|---|---|
| `actions`, `commands` | targets for the joints, and targets for the robot |
| `observations`, `noise`, `modifiers` | inputs of the policy, and their noise and filters |
| `rewards`, `terminations`, `curriculums` | rewards, ends of episodes, and settings that change during training |
| `events`, `recorders` | resets, disturbances, randomisation; and values for datasets |
| `schedules`, `config_address` | functions and addresses for curricula that change any setting |
"""
