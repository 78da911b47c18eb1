"""Makes a user's own project: a robot, a task, a term of its own in Python, and a test.

The part looks at the robot's numbers with ``physics`` and writes YAML and text; nothing but the command imports it.
"""
