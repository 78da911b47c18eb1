"""Create a user's project: a robot, a task, a reward term in Python, and a test.

| module | what it offers |
|---|---|
| `create` | copy the robot's file with all files that it names, write and check all files, move them to their place |
| `survey` | measure the robot and choose its standing pose |

| `robot_yaml` | write the robot's config |
"""
