"""Create a user's project: a robot, a task, a reward term in Python, and a test.

| module | what it offers |
|---|---|
| `create` | write everything next to its place, check it, and move it there |
| `survey` | measure the robot and choose its standing pose |
| `robot_files` | copy the robot's file with all files that it names |
| `robot_yaml`, `task_yaml` | write the configs |
"""
