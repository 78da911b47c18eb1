"""A sample of a training: whole episodes of one environment, so that they have a beginning, an end and a return."""

from __future__ import annotations


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
