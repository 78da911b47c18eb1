"""Jobs of the commands: each job joins asset, environment, learning, run, and recording into one piece of work.

The page docs/modules.md lists the modules, with the first line of each module.
"""
