"""How many environments may be drawn: the one message of the check and of the camera."""

from __future__ import annotations

from wheelleg_exp.errors import ConfigError


def too_many(num_envs: int, limit: int, sensor_key: str) -> ConfigError | None:
    """Return the mistake of more environments than a camera may draw, or None.

    Args:
        num_envs: the environments.
        limit: the camera's ``max_num_envs``.
        sensor_key: its config key.
    """
    if num_envs <= limit:
        return None
    return ConfigError(
        f"{num_envs} environments would be drawn one after another at every reading",
        key=f"{sensor_key}.max_num_envs",
        expected=f"env.num_envs at most {limit}, or a higher limit here; a RayCasterCamera measures distances of many",
    )
