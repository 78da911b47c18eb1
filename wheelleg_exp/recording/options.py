"""What may stand under ``recording.`` in the config: what runs of all versions have has no default."""

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
