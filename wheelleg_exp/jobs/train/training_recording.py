"""Record a training: sample episodes and films every so many iterations, and the scalars of every iteration."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from wheelleg_exp.config.schema import RecordingOptions
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.rollout_files import ObservingRecording, run_documents
from wheelleg_exp.recording.writing.recorder import Recorder
from wheelleg_exp.recording.writing.resume_recording import move_aside
from wheelleg_exp.rendering import video_file
from wheelleg_exp.rendering.live_pictures import LivePictures
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.rendering.renderer import NoGraphics
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.state import host_copy

_FILM_SIZE_PX = (640, 360)
_MAX_FPS = 30.0  # A video shows every n-th control step, with at most about 30 pictures per second.
_FILM_NAME = re.compile(r"iteration_(\d+)\.mp4")


class Films:
    """A context manager that makes videos of the first recorded environment, without any effect on the training.

    A video starts with every ``video_every``-th iteration, ends after ``steps`` control steps at the latest, and is
    rendered between two iterations. After a rendering error, which ``ended`` describes, there are no videos.
    """

    def __init__(self, folder: Path, env: ManagerBasedRLEnv, options: RecordingOptions, start_iteration: int) -> None:
        self._folder, self._env = folder, env
        self._every, self._steps, self._row = options.video_every, options.steps, options.env_ids[0]
        self._stride = max(1, round(1 / (_MAX_FPS * env.step_dt)))
        self._positions: list[Array] = []
        self._start: int | None = None
        self.ended: str | None = None
        self._begin(start_iteration)

    def __enter__(self) -> Films:
        self._env.observers.append(self._observe)
        return self

    def __exit__(self, *error: object) -> None:
        self._env.observers.remove(self._observe)
        self._finish()

    def write(self, iteration: int) -> None:
        """Render a video that ends with ``iteration``; start a new video every ``video_every`` iterations."""
        if len(self._positions) >= self._steps or (iteration + 1) % self._every == 0:
            self._finish()
        self._begin(iteration + 1)

    def _begin(self, iteration: int) -> None:
        if iteration % self._every == 0 and self.ended is None:
            self._start = iteration

    def _observe(self) -> None:
        if self._start is not None and len(self._positions) < self._steps:
            self._positions.append(host_copy(self._env.scene.sim.view("qpos")[self._row]).astype(float))

    def _finish(self) -> None:
        shown, start = self._positions[:: self._stride], self._start
        self._positions, self._start = [], None
        if start is None or not shown:
            return
        from av.error import FFmpegError  # Import the video encoder only when needed, because its import is slow.

        path, fps = self._folder / f"iteration_{start}.mp4", 1 / (self._env.step_dt * self._stride)
        try:
            with closing(_pictures(self._env)) as pictures:
                video_file.write(path, map(pictures.draw, shown), fps, _FILM_SIZE_PX)
        except (WheellegError, FFmpegError) as error:
            self.ended = f"no film from iteration {start} on: {error}"


def require_graphics(env: ManagerBasedRLEnv, options: RecordingOptions) -> None:
    """If videos are requested, render one picture, so that a machine without graphics fails before the training."""
    if not options.video_every:
        return
    try:
        with closing(_pictures(env)) as pictures:
            pictures.draw(env.scene.model.qpos0)
    except NoGraphics as error:
        error.key, error.expected = "recording.video_every", f"0 for no films, or {error.expected}"
        raise


def films_from(folder: Path, iteration: int) -> list[Path]:
    """Return the files of all videos that start with ``iteration`` or a later iteration."""
    found = ((path, _FILM_NAME.fullmatch(path.name)) for path in folder.glob("*.mp4"))
    return [path for path, match in found if match and int(match[1]) >= iteration]


def _pictures(env: ManagerBasedRLEnv) -> LivePictures:
    return LivePictures(env.scene.model, env.scene.robot.body_names[0], *_FILM_SIZE_PX)


class TrainingRecording(ObservingRecording):
    """A context manager that records a training: the scalars of each iteration, and sample episodes.

    At every ``interval``-th iteration, whole episodes are recorded in each environment until they have at least
    ``steps`` frames together, unless the file could become too large. A resumed run records the same episodes. A
    ``start_iteration`` above 0 continues the run's recording: frames after the present control step are dropped.
    """

    def __init__(
        self,
        directory: RunDirectory,
        env: ManagerBasedRLEnv,
        options: RecordingOptions,
        documents: Mapping[str, str],
        *,
        start_iteration: int = 0,
    ) -> None:
        path, name, ids = directory.recording, directory.id, options.env_ids
        about = {"task": directory.path.parent.name}
        aside = move_aside(path, go_on=start_iteration > 0)
        kept = env.common_step_counter if start_iteration > 0 else None
        recorder = Recorder(
            path, env, recording_id=name, name=name, env_ids=ids, purpose="training", about=about, keep_until=kept
        )
        super().__init__(env, recorder, live=options.live)
        self._options, self._first = options, start_iteration
        for name, text in {**run_documents(directory), **documents}.items():
            # After a resume, the recording keeps the manifest from the start of the run.
            if name != "manifest" or not self._recorder.has_document(name):
                self._recorder.document(name, text)
        if aside:
            self._recorder.say(f"{aside}; this one starts with iteration {start_iteration}")
        # The longest recording of an iteration has ``options.steps - 1`` frames and one more full episode.
        self._longest = options.steps - 1 + env.max_episode_length
        self._room = self._recorder.frames_within(options.max_mb)
        self.notes = [note for note in (aside, self._warning()) if note]

    def _begin_recording(self) -> None:
        self._begin(self._first)
        if self._first == 0:
            self._note_bound(0)

    def _warning(self) -> str | None:
        """Return a warning if the recorded episodes of one iteration may not fit into the file's size limit."""
        if self._longest <= self._room:
            return None
        return (
            f"recording.max_mb={self._options.max_mb:g} leaves no room for a sample, which has up to {self._longest} "
            "steps, in addition to shapes and texts, so no motion is recorded; "
            f"{self._recorder.megabytes(self._longest):.1f} are enough for one"
        )

    @property
    def unfinished(self) -> str | None:
        """The reason why the closed recording file is incomplete; None if the file is complete or still open."""
        return self._recorder.unfinished

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Write the scalars of one training iteration; at every ``interval``-th iteration, start to record episodes."""
        self._recorder.scalars(scalars, iteration)
        following = iteration + 1
        if following % self._options.interval == 0:
            self._recorder.flush()
            self._begin(following)
            self._note_bound(following)
        else:
            self._recorder.flush(everything=False)
            self._recorder.iteration = following
        if self._live is not None:
            self._live.show()

    def flush(self) -> None:
        """Write all data that are in memory to the recording file."""
        self._recorder.flush()

    def _begin(self, iteration: int) -> None:
        self._recorder.iteration = iteration
        # The control step at the start of the latest iteration that is a multiple of ``interval``.
        due = now = self._env.common_step_counter
        if iteration:
            due -= (iteration % self._options.interval) * (now // iteration)
        self._recorder.sample(due, self._options.steps if self._has_room(due) else 0, self._longest)

    def _has_room(self, due: int) -> bool:
        return self._recorder.frames_until(due) + self._longest <= self._room

    def _note_bound(self, iteration: int) -> None:
        """Write a note into the recording when no further episodes fit into its size limit."""
        due, interval = self._env.common_step_counter, self._options.interval
        if self._has_room(due):
            return
        if iteration == 0:
            self._recorder.say(str(self._warning()))
            return
        if self._recorder.frames_until(due) > self._recorder.frames_until(due - interval * (due // iteration)):
            bound, count = self._options.max_mb, iteration // interval
            text = f"the bound of {bound:g} MB is reached after {count} {'sample' if count == 1 else 'samples'}; "
            self._recorder.say(text + "from here on there are scalars alone")
