"""Command terms: what the robot is asked to do.

| module | what it offers |
|---|---|
| `velocity` | velocities in the base's axes, uniform or normal |
| `travel` | velocities, and how far the robot is from where they would have brought it |
| `pose` | places to go to, and poses of a body |
| `base_pose` | height and tilt of the base |
| `null` | no command |
| `ranges` | ranges that a curriculum may change |
"""

from wheelleg_exp.mdp.commands.command_ranges import NullCommand
from wheelleg_exp.mdp.commands.pose_commands import (
    TerrainBasedPose2dCommand,
    UniformBasePoseCommand,
    UniformPose2dCommand,
    UniformPoseCommand,
)
from wheelleg_exp.mdp.commands.velocity_commands import (
    NormalVelocityCommand,
    UniformVelocityCommand,
    UniformVelocityTravelCommand,
)

__all__ = [
    "NormalVelocityCommand",
    "NullCommand",
    "TerrainBasedPose2dCommand",
    "UniformBasePoseCommand",
    "UniformPose2dCommand",
    "UniformPoseCommand",
    "UniformVelocityCommand",
    "UniformVelocityTravelCommand",
]
