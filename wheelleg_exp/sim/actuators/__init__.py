"""Actuator models, which compute MuJoCo controls from joint targets before each physics step.

Names and parameters are Isaac Lab's. Every model except ``ImplicitActuator`` computes its torque from the state before
each physics step.

| model | torque |
|---|---|
| `ImplicitActuator` | PD drive inside the solver, clipped to the effort limit |
| `IdealPDActuator` | PD, clipped to the effort limit |
| `DCMotor` | PD, clipped to a motor's torque-speed curve |
| `DelayedPDActuator` | `IdealPDActuator` on targets that are some physics steps old |
| `RemotizedPDActuator` | `DelayedPDActuator`, clipped to a torque that depends on the joint's position |
| `ActuatorNetMLP`, `ActuatorNetLSTM` | output of a network, clipped to a motor's torque-speed curve |

`actuator_base` has the base class, `pd_actuators` the models with gains, `network_actuators` the learned models.
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
