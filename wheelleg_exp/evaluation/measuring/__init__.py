"""What is measured of the episodes of each test: columns, one number an episode.

| module | what it offers |
|---|---|
| `standing`, `walking`, `stepping` | posture and drift; errors and skill on a grid of commands; answers to steps |
| `pushing`, `on_terrain`, `changed_world` | pushes, rough ground, one thing of the world changed at a time |
| `motors` | effort, energy and chatter |
"""
