"""What a robot did in the recorded frames: tracking, base motion, contact forces, efforts, rewards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.questions.columns import frames_for
from wheelleg_exp.inspection.questions.statistics import Moment, Statistics, statistics
from wheelleg_exp.inspection.questions.view import Frames, View
from wheelleg_exp.recording.reading.plain import as_number

TOTAL = "total"
_AT_LIMIT = 1.0 - 1e-6  # float32 against the float64 of the limit


@dataclass(frozen=True)
class TrackingError:
    """How a velocity followed its command: what it was minus what was asked for, over all frames.

    Attributes:
        command: the command.
        name: which velocity: ``v_x``, ``v_y`` (m/s), ``w_z`` (rad/s).
        rmse, mean_absolute, mean, largest: root mean square, mean size, mean and largest size of the error.
        mean_command: the mean of what was asked for.
    """

    command: str
    name: str
    rmse: float
    mean_absolute: float
    mean: float
    largest: float
    mean_command: float | None


@dataclass(frozen=True)
class ForceExtreme:
    """The contact force of one body.

    Attributes:
        sensor, body: where it was measured.
        largest_n: the largest norm within a step, N; where that was not recorded, at the end of one.
        at: when that was.
        mean_n: the mean norm at the end of a step, N.
        contact_share: share of the frames with any force at their end.
    """

    sensor: str
    body: str
    largest_n: float
    at: Moment | None
    mean_n: float
    contact_share: float


@dataclass(frozen=True)
class EffortUse:
    """How much of its effort a joint used.

    Attributes:
        joint: the joint.
        limit: its effort limit, N·m (N); None when it was not recorded or there is none.
        rms, largest: root mean square and largest size of the applied effort.
        saturated_share: share of the frames at the limit; None without a limit.
    """

    joint: str
    limit: float | None
    rms: float
    largest: float
    saturated_share: float | None


@dataclass(frozen=True)
class RewardShare:
    """What one reward term gave.

    Attributes:
        term: the term.
        weight: its weight as configured; None when it was not recorded.
        mean: its mean, 1/s; None when there is no number.
        total: its sum over the recorded time.
        share: its share of the sum of the terms' sizes, 0 to 1; None when that is 0.
    """

    term: str
    weight: float | None
    mean: float | None
    total: float
    share: float | None


def tracking_errors(view: View) -> list[TrackingError]:
    """Return the errors of every commanded number that the base has by the same name."""
    found = []
    for name in view.names("commands"):
        command, _, part = name.rpartition(".")
        if command and part in view.names("base"):
            words = (f"commands.{name}", f"base.{part}")
            both = [frames for env_id in view.env_ids for frames in _together(view, words, env_id)]
            asked, actual = (np.concatenate([frames.column(word) for frames in both]) for word in words)
            error = actual - asked
            found.append(_tracking_error(command, part, error, asked))
    return [error for error in found if error is not None]


def base_motion(view: View) -> dict[str, Statistics]:
    """Return the statistics of the base's height and angles, as far as they were recorded."""
    present = [name for name in ("height", "roll", "pitch") if name in view.names("base")]
    return {name: statistics(view.column("base", name), lambda row: view.moment("base", row)) for name in present}


def force_extremes(view: View) -> list[ForceExtreme]:
    """Return the contact forces of every sensor and body; peaks within a step where they were recorded."""
    names = view.names("contacts")
    found = []
    for sensor, body in _bodies(view):
        name = f"{sensor}.{body}"
        norms = view.column("contacts", name)
        peaks = view.column("contacts", f"{sensor}.peak.{body}") if f"{sensor}.peak.{body}" in names else norms
        if len(norms):
            row = int(np.nanargmax(np.nan_to_num(peaks, nan=-1.0)))
            at = view.moment("contacts", row)
            known = norms[np.isfinite(norms)]
            mean, share = (float(known.mean()), float(np.mean(known > 0.0))) if len(known) else (0.0, 0.0)
            found.append(ForceExtreme(sensor, body, float(peaks[row]), at, mean, share))
    return found


def effort_use(view: View) -> list[EffortUse]:
    """Return how much of its effort each joint used."""
    joints = [name.removesuffix(".effort") for name in view.names("joints") if name.endswith(".effort")]
    found = []
    for joint in joints:
        size = np.abs(view.column("joints", f"{joint}.effort"))
        size = size[np.isfinite(size)]
        if len(size):
            limit = _limit(view, joint)
            share = None if limit is None else float(np.mean(size >= limit * _AT_LIMIT))
            found.append(EffortUse(joint, limit, float(np.sqrt(np.mean(size**2))), float(size.max()), share))
    return found


def reward_shares(view: View) -> list[RewardShare]:
    """Return the share of each reward term."""
    static = view.static("rewards")
    weights = dict(zip(static.get("terms", []), static.get("weights", []), strict=False))
    rows = {name: view.column("rewards", name) for name in view.names("rewards") if name != TOTAL}
    sizes = {name: float(np.nansum(np.abs(values))) for name, values in rows.items()}
    everything = sum(sizes.values())
    step_dt = view.recording.step_dt or 0.0
    return [
        RewardShare(
            term=name,
            weight=as_number(weights.get(name)),
            mean=_mean(values),
            total=float(np.nansum(values)) * step_dt,
            share=sizes[name] / everything if everything else None,
        )
        for name, values in rows.items()
    ]


def _together(view: View, names: tuple[str, ...], env_id: int) -> list[Frames]:
    """Return the rows of numbers side by side; nothing when the environment has not all of them."""
    known = view.recording.all_numbers(env_id)
    if not all(name in known for name in names):
        return []
    return frames_for(view.recording, names, replace(view.selection, env_id=env_id))


def _tracking_error(
    command: str, name: str, error: NDArray[np.float64], asked: NDArray[np.float64]
) -> TrackingError | None:
    known = error[np.isfinite(error)]
    if not len(known):
        return None
    return TrackingError(
        command=command,
        name=name,
        rmse=float(np.sqrt(np.mean(known**2))),
        mean_absolute=float(np.abs(known).mean()),
        mean=float(known.mean()),
        largest=float(np.abs(known).max()),
        mean_command=_mean(asked),
    )


def _bodies(view: View) -> Iterator[tuple[str, str]]:
    """Yield every sensor with each of its bodies."""
    recording = view.recording
    branch = recording.branch(view.env_ids[0])
    root = f"{branch}/contacts" if branch else "contacts"
    for entity in recording.entities():
        above, _, sensor = entity.rpartition("/")
        if above == root and "scalars" in recording.columns(entity):
            yield from ((sensor, body) for body in recording.names(entity))


def _limit(view: View, joint: str) -> float | None:
    entity = view.recording.all_numbers(view.env_ids[0])[f"joints.{joint}.effort"].entity
    said = view.recording.static(entity.rpartition("/")[0]).get("effort_limit")
    limit = as_number(said[0]) if said else None
    return limit if limit is not None and np.isfinite(limit) else None


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the numbers among values, None when there are none."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None
