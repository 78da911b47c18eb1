"""The config section ``recording``, and the choice of the episodes of a training that are recorded."""

from __future__ import annotations

from dataclasses import dataclass

from wheelleg_exp.constraints import Count, Natural, NonNegative


@dataclass(frozen=True)
class RecordingOptions:
    """The config section ``recording``. Options that runs of all versions have get no default.

    Attributes:
        enabled: whether a recording is written.
        env_ids: environments whose motion is recorded.
        interval: iterations between the starts of two samples of whole episodes.
        steps: control steps after which a sample ends with its current episode.
        max_mb: largest size of the recorded motion, MB; scalars are not limited.
        live: whether a viewer is opened that shows the run.
        video_every: iterations between two films of the first of ``env_ids``, ``steps`` control steps long; 0 makes no
            films. Runs of earlier versions do not have this option.
    """

    enabled: bool
    env_ids: list[Natural]
    interval: Count
    steps: Count
    max_mb: NonNegative
    live: bool
    video_every: Natural = 0


class Sample:
    """Decides for each control step whether it is recorded.

    A sample starts with the next episode, and ends with the episode in which it has enough steps. A checkpoint need not
    contain the sample's state, because the state follows from the recorded steps.

    Attributes:
        steps: the recorded control steps in order, including those of an earlier file.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self._enough = self._most = self._taken = 0
        self._is_in_episode = False

    def begin(self, enough: int, most: int, *, taken: int, is_in_episode: bool) -> None:
        """Start or continue a sample.

        Args:
            enough: recorded control steps after which no other episode is started; 0 records nothing.
            most: recorded control steps after which even the current episode is cut off.
            taken: number of control steps that are already recorded.
            is_in_episode: whether the current episode is recorded.
        """
        self._enough, self._most, self._taken = enough, most, taken
        self._is_in_episode = is_in_episode and enough > 0

    def takes(self, episode_step: int) -> bool:
        """Return whether a control step is recorded, given its number within its episode, from 1."""
        begins = episode_step == 1 and self._taken < self._enough
        self._is_in_episode = (self._is_in_episode or begins) and self._taken < self._most
        return self._is_in_episode

    def took(self, *, ends: bool) -> None:
        """Count a recorded step; ``ends`` says whether its episode ended."""
        self._taken += 1
        self._is_in_episode = not ends
