"""Find all mistakes in a config at one time, without a simulation.

| module | contents |
|---|---|
| `find_mistakes` | every mistake, including those at which Hydra stops, and those in defaults lists |
| `check_agent` | the agent's keys and classes |
| `check_terms` | terms, and references between sections |
| `check_robot_names` | names of joints, bodies and sensors against the robot |
"""
