"""Sensors of the scene.

| name | what it measures |
|---|---|
| `SensorBase` | nothing: the base class of all, also of a user's own |
| `ContactSensor` | net normal contact forces on bodies, contact and air times: `ContactSensorData` |
"""

from wheelleg_exp.sim.sensors.base import SensorBase
from wheelleg_exp.sim.sensors.contact import ContactSensor
from wheelleg_exp.sim.sensors.contact_data import ContactSensorData

__all__ = ["ContactSensor", "ContactSensorData", "SensorBase"]
