"""Event files of one run, started one after another."""

from __future__ import annotations

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from wheelleg_exp.jobs.train.scalar_logs import event_files, open_events


def test_files_begun_in_a_moment_are_read_in_their_order(tmp_path: Path) -> None:
    with open_events(tmp_path) as writer:
        writer.add_scalar("a", 0.0, 0)
    (first,) = event_files(tmp_path)
    older = first.rename(first.with_name(f"{first.name.rpartition('.')[0]}.9x"))  # sorts after any number
    with open_events(tmp_path) as writer:
        writer.add_scalar("a", 1.0, 1)
    assert event_files(tmp_path)[0] == older
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    assert [event.step for event in accumulator.Scalars("a")] == [0, 1]
