"""Sensors of the scene: contacts, ray casters, cameras, IMUs, and the base classes of user-defined sensors."""

from wheelleg_exp.sim.sensors.cameras import Camera, CameraData, RayCasterCamera
from wheelleg_exp.sim.sensors.contact_sensor import ContactSensor, ContactSensorData
from wheelleg_exp.sim.sensors.imu_sensor import Imu, ImuData, ImuNoise
from wheelleg_exp.sim.sensors.ray_caster import RayCaster, RayCasterData
from wheelleg_exp.sim.sensors.ray_patterns import BpearlPattern, GridPattern, LidarPattern, PatternBase, PinholePattern
from wheelleg_exp.sim.sensors.sensor_base import LazySensor, SensorBase, require_base_called
