"""Actuator models: what turns joint targets into MuJoCo controls, before each physics step.

Names and numbers are Isaac Lab's. A model that is not ``ImplicitActuator`` computes its torque from the state before
each physics step.

| model | torque |
|---|---|
| `ImplicitActuator` | the solver's own PD drive, clipped to the effort limit |
| `IdealPDActuator` | PD, clipped to the effort limit |
| `DCMotor` | PD, clipped to a motor's torque-speed curve |
| `DelayedPDActuator` | `IdealPDActuator` on targets of some physics steps ago |
| `RemotizedPDActuator` | the same, clipped to a torque that depends on the joint's position |
| `ActuatorNetMLP`, `ActuatorNetLSTM` | what a network says, clipped to a motor's torque-speed curve |

| module | what it holds |
|---|---|
| `base` | the numbers of a group of joints, by environment, and the models' face |
| `delay` | targets of some physics steps ago |
| `pd`, `motors` | models with gains |
| `networks`, `network_file` | learned models, and the TorchScript files that they are read from |
"""

from wheelleg_exp.sim.actuators.actuator_base import (
    NEEDED,
    ONE_GROUP,
    ActuatorBase,
    Limit,
    LimitPerJoint,
    PerJoint,
    Stream,
)
from wheelleg_exp.sim.actuators.network_actuators import ActuatorNetLSTM, ActuatorNetMLP
from wheelleg_exp.sim.actuators.pd_actuators import (
    DCMotor,
    DelayedPDActuator,
    IdealPDActuator,
    ImplicitActuator,
    RemotizedPDActuator,
)

__all__ = [
    "NEEDED",
    "ONE_GROUP",
    "ActuatorBase",
    "ActuatorNetLSTM",
    "ActuatorNetMLP",
    "DCMotor",
    "DelayedPDActuator",
    "IdealPDActuator",
    "ImplicitActuator",
    "Limit",
    "LimitPerJoint",
    "PerJoint",
    "RemotizedPDActuator",
    "Stream",
]
