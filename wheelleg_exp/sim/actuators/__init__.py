"""Actuator models, as in Isaac Lab, which compute MuJoCo controls from joint targets before each physics step."""

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
