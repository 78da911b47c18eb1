"""Makes a user's own project: a robot, a task, a term of its own in Python, and a test.

| module | what it offers |
|---|---|
| `create` | writes everything beside its place, checks it, and moves it there |
| `survey`, `gains` | what is measured of the robot, and its gains |
| `robot_files` | copies its file with all that it is made of |
| `robot_yaml`, `task_yaml`, `yaml_text` | the configs |
| `project_names` | names that a project may have |
"""
