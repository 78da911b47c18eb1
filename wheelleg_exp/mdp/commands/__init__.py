"""Command terms: targets for the robot, such as velocities and poses.

| module | what it offers |
|---|---|
| `velocity_commands` | velocities in the base's axes, uniform or normal, or with an integrated error |
| `pose_commands` | positions to drive to, poses of a body, height and tilt of the base, jumps |
| `command_ranges` | ranges that a curriculum can change, and the command without components |
"""

from wheelleg_exp.mdp.commands.command_ranges import NullCommand
from wheelleg_exp.mdp.commands.pose_commands import (
    JumpCommand,
    TerrainBasedPose2dCommand,
    UniformBasePoseCommand,
    UniformPose2dCommand,
    UniformPoseCommand,
    WheeledBasePoseCommand,
)
from wheelleg_exp.mdp.commands.velocity_commands import (
    NormalVelocityCommand,
    UniformVelocityCommand,
    UniformVelocityTravelCommand,
)
