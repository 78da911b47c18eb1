"""Report section on recordings: the run's recordings, and pictures of the robot from them."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.plot_data import Sample, Source
from wheelleg_exp.inspection.recording_pictures import Scenery, pictures, row_at, scenery
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.report import performance_section as standing
from wheelleg_exp.report.page_blocks import Block, Note, Picture, Strip
from wheelleg_exp.report.performance_section import health
from wheelleg_exp.report.report_subject import AGENT, Subject
from wheelleg_exp.report.value_format import number, spoken

_HERO, _STRIP = (960, 720), (480, 360)
_MOMENTS = 4
_FIRST, _LAST, _PLAY = 0, -1, 1  # A report shows the first and last training episode, and an evaluated episode.


@dataclass(frozen=True)
class Episode:
    """A recorded episode: the simulated time of its first and last row, s, and the terminations that ended it."""

    start: float
    end: float
    step_s: float
    ended_by: tuple[str, ...]
    is_whole: bool  # True if the episode was recorded from its start to its end.

    @property
    def seconds(self) -> float:
        return self.end - self.start + self.step_s


@dataclass
class Look:
    """Opens each recording of a run only once; the report shows an error if a recording cannot be read."""

    subject: Subject
    pictures: bool = True  # False omits all pictures of the robot from the report.
    _missing: str | None = field(default=None, init=False)
    _sceneries: dict[Path, Scenery] = field(default_factory=dict, init=False)

    @cached_property
    def training(self) -> Recording | WheellegError | None:
        """The training's recording; an error if the recording cannot be opened; None if there is no recording."""
        return None if self.subject.status == AGENT else _opened(self.subject.file("recording.rrd"))

    @cached_property
    def play(self) -> Recording | WheellegError | None:
        """The last rollout's recording; an error if the recording cannot be opened; None if there is no recording."""
        if self.subject.status == AGENT:
            return _opened(self.subject.file("recording.rrd"))
        plays = self.subject.additions("play")
        names = [name for name in plays[-1].files if name.endswith(".rrd")] if plays else []
        return _opened(self.subject.file(names[0])) if names else None

    def hero(self) -> Picture | None:
        """Return the picture at the top of the page: the robot in its last episode."""
        for recording in (self.play, self.training):
            if recording is None or isinstance(recording, WheellegError):
                continue
            found = _shown(Source(recording), _PLAY if recording is self.play else _LAST)
            if found is not None:
                episode = found[1]
                where = "in the last play" if recording is self.play else "in the last recorded episode of the training"
                where = "in this run" if self.subject.status == AGENT else where
                at = episode.start + 0.5 * (episode.end - episode.start)
                caption = f"The robot {where}, {_clock(at - episode.start)} into the episode."
                return next(iter(self._pictures(recording, [at], _HERO, [caption], [caption])), None)
        return None

    def of_play(self) -> list[Block]:
        """Return the pictures and curves of the policy's last recorded ``wheelleg play``."""
        recording = self.play
        if recording is None:
            return []
        if isinstance(recording, WheellegError):
            return [Note(f"The recording cannot be shown: {recording}.")]
        label = "The agent" if self.subject.status == AGENT else "The play"
        return [*health(recording), *self._strip(recording, _PLAY, label), *standing.motion(recording)]

    def of_training(self) -> list[Block]:
        """Return pictures of the first and the last recorded episode of the training."""
        recording = self.training
        if recording is None:
            return [Note("This training was not recorded, so there are no pictures of it.", "")]
        if isinstance(recording, WheellegError):
            return [Note(f"The recording of the training cannot be shown: {recording}.")]
        found: list[Block] = [*health(recording), *self._strip(recording, _FIRST, "At first")]
        samples = Source(recording).samples()
        if not samples:
            found.append(Note("No motion of this training was recorded, so there are no pictures of it.", ""))
        if len(samples) > 1:
            found += self._strip(recording, _LAST, "At last")
        return [*found, *([Note(f"There are no pictures of the robot: {self._missing}.", "")] if self._missing else [])]

    def _strip(self, recording: Recording, which: int, label: str) -> list[Block]:
        source = Source(recording)
        found = _shown(source, which)
        if found is None:
            return []
        sample, episode = found
        times = [float(time) for time in np.linspace(episode.start, episode.end, _MOMENTS)]
        title = _title(label, sample, episode, source.whose, is_play=which == _PLAY)
        clocks = [_clock(time - episode.start) for time in times]
        alts = [f"The robot after {clock}. {title}" for clock in clocks]
        pictures = self._pictures(recording, times, _STRIP, alts, clocks)
        return [Strip(title, pictures)] if pictures else []

    def _pictures(
        self, recording: Recording, times: list[float], size: tuple[int, int], alts: list[str], captions: list[str]
    ) -> list[Picture]:
        """Return pictures of the robot; after the first error in drawing a picture, return no pictures."""
        if not self.pictures or self._missing is not None:
            return []
        try:
            if recording.path not in self._sceneries:
                self._sceneries[recording.path] = scenery(recording)
            uris = shots(self._sceneries[recording.path], times, size)
        except WheellegError as error:
            self._missing = str(error)
        except Exception as error:  # A graphics driver can raise any error, after which the report has no pictures.
            self._missing = f"{type(error).__name__}: {error}"
        else:
            return [Picture(u, *size, alt=a, caption=c) for u, a, c in zip(uris, alts, captions, strict=True)]
        return []

    @property
    def notes(self) -> Sequence[str]:
        """The reason why the report has no pictures of the robot, which ``wheelleg report`` prints."""
        return [f"no pictures of the robot: {self._missing}"] if self._missing else []


def _opened(path: Path | None) -> Recording | WheellegError | None:
    if path is None:
        return None
    try:
        return Recording(path)
    except WheellegError as error:
        return error
    except Exception as error:  # A damaged recording can raise any error.
        return WheellegError(f"{type(error).__name__}: {error}")


def _shown(source: Source, which: int) -> tuple[Sample, Episode] | None:
    """Return the recorded interval (sample) and, from this interval, the episode that the report's pictures show."""
    # If ``which`` is ``_FIRST``, show the first recorded episode of the training.
    # If ``which`` is ``_PLAY``, show the first recorded episode of ``wheelleg play``.
    # If ``which`` is ``_LAST``, show a complete episode from the latest recorded interval that contains one.
    # If no recorded training episode is complete, show the longest episode of the last recorded interval.
    samples = source.samples()
    if which == _LAST:
        for sample in reversed(samples):
            whole = next((one for one in _episodes(source, sample) if one.is_whole), None)
            if whole is not None:
                return sample, whole
        found = _episodes(source, samples[-1]) if samples else []
        return (samples[-1], max(found, key=lambda one: one.seconds)) if found else None
    found = _episodes(source, samples[0]) if samples else []
    return (samples[0], found[0]) if found else None


def _episodes(source: Source, sample: Sample) -> list[Episode]:
    """Split consecutive recorded control steps (a sample) into episodes; the first and the last can be incomplete."""
    clock = source.clock()
    if clock is None:
        return []
    rows = sample.of(clock)
    lasts = [int(step) for step in source.ends() if sample.first <= step <= sample.last]
    lasts += [] if lasts and lasts[-1] == sample.last else [sample.last]
    firsts = [sample.first, *(step + 1 for step in lasts[:-1])]
    fired, age, found = source.fired(), source.maybe("episode", "step"), []
    for own in (rows.rows((rows.step >= a) & (rows.step <= b)) for a, b in zip(firsts, lasts, strict=True)):
        if len(own.step):
            last, time = int(own.step[-1]), own.time
            causes = [name for name, series in fired.items() if bool(series.first[series.step == last].any())]
            step_s = float(time[1] - time[0]) if len(time) > 1 else 0.0
            begins = age is None or bool((age.first[age.step == int(own.step[0])] == 1).any())
            found.append(Episode(float(time[0]), float(time[-1]), step_s, tuple(causes), begins and bool(causes)))
    return found


def _title(label: str, sample: Sample, episode: Episode, whose: str, *, is_play: bool) -> str:
    when = "" if sample.iteration is None else f", iteration {number(sample.iteration)}"
    which = f", first episode{f' of {whose}' if whose else ''}" if is_play else f", {whose}" if whose else ""
    causes = " and ".join(spoken(cause) for cause in episode.ended_by)
    how = f"ended by {causes}" if causes else f"still running at the end of the {'recording' if is_play else 'sample'},"
    return f"{label}{when}{which}: {how} after {_clock(episode.seconds)}"


def _clock(seconds: float) -> str:
    return f"{seconds:.2f} s"


def shots(shown: Scenery, times: Sequence[float], size: tuple[int, int]) -> list[str]:
    """Return pictures of the robot at several moments, as data URIs of ``size`` px, with one camera distance."""
    rows = [row_at(shown, time_s=time) for time in times]
    found = []
    for pixels in pictures(shown, rows, *size):
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "JPEG", quality=84, optimize=True)
        found.append("data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii"))
    return found
