"""How what sensors measure turns in a mirror: rays change places, an IMU's axes may be turned in its body."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.symmetry.bodies import MIRROR, BodyImages
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.sensors import Imu, RayCaster

Turned = list[tuple[int, float]]
_NEAR = 1e-4  # m, and of unit directions: rays that differ by more are no images
_EXACT = 1e-3  # of a matrix of signs


def rays(sensor: Any, bodies: BodyImages, path: str) -> Turned:
    """Return which ray each ray's image is: from the mirrored place, in the mirrored direction.

    Raises:
        ConfigError: the sensor casts no rays, or they are not the same to both sides.
    """
    if not isinstance(sensor, RayCaster):
        raise ConfigError("is no ray caster", key=f"{path}.sensor_cfg.name", expected="a RayCaster")
    _require_own_image(sensor.body_names[0], bodies, f"{sensor.key}.body_name")
    flip = torch.tensor([1.0, -1.0, 1.0], device=sensor.device)
    found = torch.cat([part.expand(sensor.num_rays, 3) for part in sensor.rays], dim=1)
    distance, source = torch.cdist(found * flip.repeat(2), found).min(dim=1)
    if float(distance.max()) > _NEAR:
        expected = "an offset on the base's middle, and a pattern with a ray to the right for each to the left"
        raise ConfigError("its rays are not the same to both sides", key=sensor.key, expected=expected)
    return [(int(number), 1.0) for number in source]


def imu(sensor: Any, kind: str, bodies: BodyImages, path: str) -> Turned:
    """Return how a vector, a pseudovector or the quaternion of an IMU turns.

    With R its axes in its body's, the image of a vector is R^T M R times it, of a pseudovector -R^T M R; where that is
    no matrix of signs, the IMU's place is none in a mirror.

    Raises:
        ConfigError: the sensor is no IMU, or its place or its axes are not their own image.
    """
    if not isinstance(sensor, Imu):
        raise ConfigError("is no IMU", key=f"{path}.asset_cfg.name", expected="an Imu")
    _require_own_image(sensor.body_names[0], bodies, f"{sensor.key}.body_name")
    pos, quat = sensor.offset_pose
    turn = rotation.quat_to_matrix(quat.unsqueeze(0))[0].double().cpu().numpy()
    if abs(float(pos[1])) > _NEAR:
        raise ConfigError("it does not sit in the middle", key=f"{sensor.key}.offset.pos", expected="y = 0")
    mirrored = turn.T @ MIRROR @ turn
    signs = np.round(mirrored)
    if np.abs(mirrored - signs).max() > _EXACT or (kind == "quaternion" and np.abs(signs - MIRROR).max() > 0):
        expected = "axes along the body's" if kind != "quaternion" else "a turn about y, or none"
        raise ConfigError(
            "its axes are no mirror image of themselves", key=f"{sensor.key}.offset.rot", expected=expected
        )
    if kind == "quaternion":
        return [(0, 1.0), (1, -1.0), (2, 1.0), (3, -1.0)]
    sign = -1.0 if kind == "pseudovector" else 1.0
    sources = np.abs(signs).argmax(axis=1)
    return [(int(source), sign * float(signs[i, source])) for i, source in enumerate(sources)]


def _require_own_image(name: str, bodies: BodyImages, key: str) -> None:
    image = bodies.image(name, key, with_axes=True)
    if image != name:
        message = f"it sits on '{name}', whose image is '{image}'"
        raise ConfigError(message, key=key, expected="a body in the middle of the robot")
