"""``render_mode="rgb_array"``: pictures of environments as they are."""

from __future__ import annotations

from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.host import host_copy
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.rendering.live import LivePictures

RENDER_MODES = ["rgb_array"]
_SIZE_PX = (16, 4096)


class Pictures:
    """Draws environments one by one; nothing of them changes.

    Args:
        env: the environment.
        mode: ``rgb_array``, or None for no pictures.
        width: px.
        height: px.

    Raises:
        ConfigError: the mode or the size is none.
    """

    def __init__(self, env: ManagerBasedRLEnv, mode: str | None, width: int, height: int) -> None:
        if mode is not None and mode not in RENDER_MODES:
            expected, nearest = " or ".join([*RENDER_MODES, "None"]), nearest_name(str(mode), RENDER_MODES)
            raise ConfigError(f"there is no mode '{mode}'", key="render_mode", expected=expected, nearest=nearest)
        for key, size in (("width", width), ("height", height)):
            whole = isinstance(size, Integral) and not isinstance(size, bool)
            if not (whole and _SIZE_PX[0] <= size <= _SIZE_PX[1]):
                expected = "a whole number of px, {} to {}".format(*_SIZE_PX)
                raise ConfigError(f"{size!r} is no size", key=key, expected=expected)
        self._env, self._mode = env, mode
        self._pictures = LivePictures(env.scene.model, env.scene.robot.body_names[0], width, height)

    def draw(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (height, width, 3) of every environment, or None where there is no mode.

        Raises:
            NoGraphics: nothing can be drawn on this machine; the message says what to install.
        """
        if self._mode is None:
            return None
        return tuple(self._pictures.draw(row) for row in host_copy(self._env.scene.sim.view("qpos")).astype(float))

    def close(self) -> None:
        """End the process that draws."""
        self._pictures.close()
