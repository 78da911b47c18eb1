"""Choose the episodes of a training that are recorded."""

from __future__ import annotations


class Sample:
    """Chooses which control steps of an environment are recorded. A sample is a recorded sequence of complete episodes.

    After a call of ``begin``, recording starts with the next episode. A resumed run learns from the recording, not from
    a checkpoint, which control steps were recorded.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self._enough = self._most = self._taken = 0
        self._is_in_episode = False

    def begin(self, enough: int, most: int, *, taken: int, is_in_episode: bool) -> None:
        """Record complete episodes from now on; if a run resumes, ``taken`` control steps are already recorded.

        After ``enough`` control steps, recording stops at the end of the current episode. If ``enough`` is 0, nothing
        is recorded. After ``most`` control steps, recording stops at once, even in the middle of an episode.
        ``is_in_episode`` is true if the earlier control steps of the current episode were recorded.
        """
        self._enough, self._most, self._taken = enough, most, taken
        self._is_in_episode = is_in_episode and enough > 0

    def takes(self, episode_step: int) -> bool:
        """Return whether to record a control step; ``episode_step`` is its number within the episode, from 1."""
        begins = episode_step == 1 and self._taken < self._enough
        self._is_in_episode = (self._is_in_episode or begins) and self._taken < self._most
        return self._is_in_episode

    def took(self, *, ends: bool) -> None:
        """Count a recorded control step; ``ends`` is true for the last control step of an episode."""
        self._taken += 1
        self._is_in_episode = not ends
