"""Sensors of the scene.

| name | what it measures |
|---|---|
| `SensorBase` | base class of all sensors, including user-defined ones |
| `LazySensor` | base class of sensors that measure when they are read |
| `ContactSensor` | net normal contact forces on bodies, contact and air times: `ContactSensorData` |
| `RayCaster` | points where rays from a body hit the ground: `RayCasterData` |
| `RayCasterCamera` | distances to the ground through a camera's pixels, by rays: `CameraData` |
| `Imu` | pose, velocities and accelerations, with errors (`ImuNoise`): `ImuData` |
| `Camera` | colours, distances and segmentation, rendered by MuJoCo: `CameraData` |
| `GridPattern` ... | patterns of rays; `PatternBase` is their base class |
"""

from wheelleg_exp.sim.sensors.cameras import Camera, CameraData, RayCasterCamera
from wheelleg_exp.sim.sensors.contact_sensor import ContactSensor, ContactSensorData
from wheelleg_exp.sim.sensors.imu_sensor import Imu, ImuData, ImuNoise
from wheelleg_exp.sim.sensors.ray_caster import RayCaster, RayCasterData
from wheelleg_exp.sim.sensors.ray_patterns import BpearlPattern, GridPattern, LidarPattern, PatternBase, PinholePattern
from wheelleg_exp.sim.sensors.sensor_base import LazySensor, SensorBase, require_base_called
