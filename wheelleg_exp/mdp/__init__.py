"""The term library: what actions, commands, observations, events, rewards, terminations and curricula compute.

| module | what it offers |
|---|---|
| `actions`, `commands` | what the policy sets, and what it is asked for |
| `observations`, `noise`, `modifiers` | what it sees, and what becomes of that |
| `rewards`, `terminations`, `curriculums` | what counts, what ends an episode, what changes while it learns |
| `events` | resets, disturbances and randomisation |
"""
