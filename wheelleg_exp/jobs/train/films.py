"""Films of a training: one environment for some seconds, every so many iterations."""

from __future__ import annotations

import re
from pathlib import Path
from types import TracebackType

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.host import host_copy
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.recording.options import RecordingOptions
from wheelleg_exp.rendering import film
from wheelleg_exp.rendering.live import LivePictures
from wheelleg_exp.rendering.renderer import NoGraphics
from wheelleg_exp.rendering.shapes import Array

_SIZE_PX = (640, 360)
_FPS = 30.0  # at most; a picture is of a control step
_NAME = re.compile(r"iteration_(\d+)\.mp4")


class Films:
    """Films the first of the recorded environments, from entering to leaving; nothing of the training changes.

    With every ``video_every``-th iteration a film begins. It ends with the iteration in which it has ``steps`` control
    steps, before the next one, or with the training. Positions are kept in memory meanwhile, and drawn between two
    iterations. What fails then ends the filming and not the training.

    Args:
        folder: where ``iteration_<n>.mp4`` appear, by the iteration with which they begin.
        env: the environment.
        options: ``video_every``, ``steps`` and ``env_ids`` are read.
        start_iteration: the first iteration that is still to come.

    Attributes:
        ended: why no more films are made; None as long as they are.
    """

    def __init__(self, folder: Path, env: ManagerBasedRLEnv, options: RecordingOptions, start_iteration: int) -> None:
        self._folder, self._env = folder, env
        self._every, self._steps, self._row = options.video_every, options.steps, options.env_ids[0]
        self._stride = max(1, round(1 / (_FPS * env.step_dt)))
        self._positions: list[Array] = []
        self._begun: int | None = None
        self.ended: str | None = None
        self._begin(start_iteration)

    def __enter__(self) -> Films:
        self._env.observers.append(self._observe)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._env.observers.remove(self._observe)
        self._finish()

    def write(self, iteration: int) -> None:
        """Draw the film when ``iteration``, which is over, was its last; begin the next one when it is due."""
        if len(self._positions) >= self._steps or (iteration + 1) % self._every == 0:
            self._finish()
        self._begin(iteration + 1)

    def _begin(self, iteration: int) -> None:
        if iteration % self._every == 0 and self.ended is None:
            self._begun = iteration

    def _observe(self) -> None:
        if self._begun is not None and len(self._positions) < self._steps:
            self._positions.append(host_copy(self._env.scene.sim.view("qpos")[self._row]).astype(float))

    def _finish(self) -> None:
        shown, begun = self._positions[:: self._stride], self._begun
        self._positions, self._begun = [], None
        if begun is None or not shown:
            return
        from av.error import FFmpegError  # the encoder takes its time to import, and few trainings are filmed

        pictures = _pictures(self._env)
        try:
            path, fps = self._folder / f"iteration_{begun}.mp4", 1 / (self._env.step_dt * self._stride)
            film.write(path, map(pictures.draw, shown), fps, _SIZE_PX)
        except (WheellegError, FFmpegError) as error:
            self.ended = f"no film from iteration {begun} on: {error}"
        finally:
            pictures.close()


def require_graphics(env: ManagerBasedRLEnv, options: RecordingOptions) -> None:
    """Draw a picture where films are asked for, so that a machine that cannot says so before the training.

    Raises:
        NoGraphics: nothing can be drawn here; the message says what to install.
    """
    if not options.video_every:
        return
    pictures = _pictures(env)
    try:
        pictures.draw(env.scene.model.qpos0)
    except NoGraphics as error:
        error.key, error.expected = "recording.video_every", f"0 for no films, or {error.expected}"
        raise
    finally:
        pictures.close()


def films_from(folder: Path, iteration: int) -> list[Path]:
    """Return the films that begin with ``iteration`` or later."""
    found = ((path, _NAME.fullmatch(path.name)) for path in folder.glob("*.mp4"))
    return [path for path, match in found if match and int(match[1]) >= iteration]


def _pictures(env: ManagerBasedRLEnv) -> LivePictures:
    return LivePictures(env.scene.model, env.scene.robot.body_names[0], *_SIZE_PX)
