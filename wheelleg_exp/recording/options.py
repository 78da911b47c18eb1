"""What may stand under ``recording.`` in the config: no defaults, so that every number is in the config."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class RecordingOptions:
    """What goes into the recording of a training.

    Attributes:
        enabled: whether a recording is written at all.
        env_ids: environments whose motion is recorded.
        interval: iterations between the starts of two recorded segments.
        steps: control steps of one recorded segment.
        max_mb: size that recorded motion may reach, MB; scalars are written beyond it.
        live: whether a viewer is opened that shows the run as it goes.
    """

    enabled: bool
    env_ids: list[int]
    interval: int = field(metadata={"minimum": 1})
    steps: int = field(metadata={"minimum": 1})
    max_mb: float = field(metadata={"minimum": 0.0})
    live: bool
