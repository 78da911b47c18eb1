import pytest

from wheelleg_exp.errors import ConfigError

PREFIX = "wheelleg_exp.sim.sensors."
PLANE = {"static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0}
OPTICS = {"width": 20, "height": 16}
GRID = {"_target_": PREFIX + "GridPattern", "resolution": 0.5, "size": [1.0, 0.5]}
NOT_A_PATTERN = {"_target_": "wheelleg_exp.mdp.noise.ConstantNoise", "bias": 1.0}
DEGREES = {"_target_": PREFIX + "LidarPattern", "channels": 2, "vertical_fov_range": [-0.3, 0.3]}
DEGREES |= {"horizontal_fov_range": [0.0, 360.0], "horizontal_res": 0.1}
NODES = {
    "RayCaster": {"pattern": GRID},
    "RayCasterCamera": {"pattern": {"_target_": PREFIX + "PinholePattern", **OPTICS}},
    "Camera": OPTICS,
    "Imu": {},
}
ROWS = [
    ("RayCaster", {"body_name": ".*"}, "body_name", "one body"),
    ("RayCaster", {"body_name": "blok"}, "body_name", "block"),
    ("RayCaster", {"pattern": {"resolution": 0.1}}, "pattern", "_target_"),
    ("RayCaster", {"pattern": 3}, "pattern", "_target_"),
    ("RayCaster", {"pattern": NOT_A_PATTERN}, "pattern", "PatternBase"),
    ("RayCaster", {"offset": {"rot": [1.0, 0.0, 0.0]}}, "offset.rot", "4 finite numbers"),
    ("RayCaster", {"offset": {"pose": [1.0, 0.0, 0.0]}}, "offset.pose", "pos"),
    ("RayCaster", {"pattern": DEGREES}, "pattern.horizontal_fov_range", "radians"),
    ("RayCasterCamera", {"data_types": ["rgb"]}, "data_types", ""),
    ("RayCasterCamera", {"pattern": GRID}, "pattern", "PinholePattern"),
    ("RayCasterCamera", {"offset": {"convention": "usd"}}, "offset.convention", ""),
    ("RayCasterCamera", {"max_distance": 0.0}, "max_distance", ""),
    ("Camera", {"max_num_envs": 1}, "max_num_envs", "2 environments"),
    ("Camera", {"data_types": ["normals"]}, "data_types", ""),
    ("Camera", {"data_types": []}, "data_types", ""),
    ("Camera", {"offset": {"convention": "usd"}}, "offset.convention", ""),
    ("Camera", {"offset": {"rot": [0, 0, 0, 0]}}, "offset.rot", ""),
    ("Camera", {"fovy": 3.2}, "fovy", ""),
    ("Camera", {"clipping_range": [1.0, 1.0]}, "clipping_range", ""),
    ("Camera", {"body_name": "head"}, "body_name", ""),
    ("Imu", {"accelerometer": {"std": 0.1}}, "accelerometer", ""),
    ("Imu", {"gyroscope": NOT_A_PATTERN}, "gyroscope", ""),
    ("Imu", {"gyroscope": {"_target_": PREFIX + "ImuNoise", "std": -1.0}}, "gyroscope.std", ""),
    ("Imu", {"gravity_bias": [9.81]}, "gravity_bias", ""),
    ("Imu", {"update_period": -1.0}, "update_period", ""),
]


@pytest.mark.parametrize(("kind", "changes", "key", "words"), ROWS)
def test_a_wrong_sensor_is_rejected_by_key(make_env, kind, changes, key, words):
    node = {"_target_": PREFIX + kind, "body_name": "block", **NODES[kind], **changes}
    with pytest.raises(ConfigError) as caught:
        make_env("block", num_envs=2, scene={"sensors": {"s": node}})
    assert caught.value.key == f"env.scene.sensors.s.{key}"
    assert words in str(caught.value)


@pytest.mark.usefixtures("allow_test_terms")
def test_another_object_is_not_a_sensor(make_env):
    with pytest.raises(ConfigError, match="is not a SensorBase"):
        make_env(scene={"sensors": {"x": {"_target_": "managers.spies.Step", "height": 1.0, **PLANE}}})
