"""The config section ``recording``, and the choice of the episodes of a training that are recorded."""

from __future__ import annotations

from dataclasses import dataclass

from wheelleg_exp.constraints import Count, Natural, NonNegative


@dataclass(frozen=True)
class RecordingOptions:
    """What goes into the recording of a training.

    Attributes:
        enabled: whether a recording is written at all.
        env_ids: environments whose motion is recorded.
        interval: iterations after which the next sample of whole episodes is due.
        steps: control steps with which a sample has enough; it ends with that episode.
        max_mb: size that recorded motion may reach, MB; scalars are written beyond it.
        live: whether a viewer is opened that shows the run as it goes.
        video_every: iterations after which the next film of the first of ``env_ids`` is due, ``steps`` control steps
            long; 0 makes none. Runs of earlier versions do not have it.
    """

    enabled: bool
    env_ids: list[Natural]
    interval: Count
    steps: Count
    max_mb: NonNegative
    live: bool
    video_every: Natural = 0


class Sample:
    """Decides of each control step whether it is taken.

    A sample begins with the next episode that does, and ends with the episode in which it has enough steps. Nothing of
    it is state that a checkpoint would have to hold: it follows from the steps that were taken before.

    Attributes:
        steps: the control steps that were taken, in order, those in an earlier file included.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self._enough = self._most = self._taken = 0
        self._is_in_episode = False

    def begin(self, enough: int, most: int, *, taken: int, is_in_episode: bool) -> None:
        """Begin a sample, or go on with one.

        Args:
            enough: control steps with which no further episode is begun; 0 is no sample.
            most: control steps at which even an episode that goes on is cut off.
            taken: how many were taken already.
            is_in_episode: whether the present episode has been taken so far.
        """
        self._enough, self._most, self._taken = enough, most, taken
        self._is_in_episode = is_in_episode and enough > 0

    def takes(self, episode_step: int) -> bool:
        """Return whether a control step is taken, by its number within its episode, from 1."""
        begins = episode_step == 1 and self._taken < self._enough
        self._is_in_episode = (self._is_in_episode or begins) and self._taken < self._most
        return self._is_in_episode

    def took(self, *, ends: bool) -> None:
        """Count a step that was taken, and whether the episode ended with it."""
        self._taken += 1
        self._is_in_episode = not ends
