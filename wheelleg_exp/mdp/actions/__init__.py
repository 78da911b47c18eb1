"""Action terms: what the policy's output sets.

| module | what it offers |
|---|---|
| `joint` | affine targets: positions, relative positions, velocities, efforts |
| `to_limits` | positions between the joints' limits, at once or as a moving average |
| `binary` | one of two targets |

A term's ``delay`` (a field of the manager) lets its targets act some physics steps later.
"""

from wheelleg_exp.mdp.actions.binary import (
    AbsBinaryJointPositionAction,
    BinaryJointAction,
    BinaryJointPositionAction,
    BinaryJointVelocityAction,
)
from wheelleg_exp.mdp.actions.joint import (
    JointAction,
    JointEffortAction,
    JointPositionAction,
    JointTerm,
    JointVelocityAction,
    RelativeJointPositionAction,
)
from wheelleg_exp.mdp.actions.to_limits import EMAJointPositionToLimitsAction, JointPositionToLimitsAction

__all__ = [
    "AbsBinaryJointPositionAction",
    "BinaryJointAction",
    "BinaryJointPositionAction",
    "BinaryJointVelocityAction",
    "EMAJointPositionToLimitsAction",
    "JointAction",
    "JointEffortAction",
    "JointPositionAction",
    "JointPositionToLimitsAction",
    "JointTerm",
    "JointVelocityAction",
    "RelativeJointPositionAction",
]
