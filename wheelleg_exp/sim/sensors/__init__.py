"""Sensors of the scene.

| name | what it measures |
|---|---|
| `SensorBase` | nothing: the base class of all, also of a user's own |
| `ContactSensor` | net normal contact forces on bodies, contact and air times |
"""

from wheelleg_exp.sim.sensors.base import SensorBase
from wheelleg_exp.sim.sensors.contact import ContactSensor

__all__ = ["ContactSensor", "SensorBase"]
