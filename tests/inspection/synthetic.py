from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import rerun as rr

STEP_DT = 0.02
STEPS = 200
AMPLITUDE = 0.3


class Writer:
    def __init__(self, path: Path, recording_id: str = "synthetic", application: str = "wheelleg") -> None:
        self.path = path
        self.stream = rr.RecordingStream(application, recording_id=recording_id, send_properties=False)
        self.stream.save(path)

    def numbers(self, entity, values, steps=None, names=None, iterations=None):
        values = np.asarray(values, dtype=float)
        steps = np.arange(1, len(values) + 1) if steps is None else np.asarray(steps)
        width = values.shape[1] if values.ndim == 2 else 1
        columns = rr.Scalars.columns(scalars=values.ravel())
        if width > 1:
            columns = columns.partition([width] * len(values))
        self.stream.send_columns(entity, times(steps, iterations), columns)
        if names:
            self.stream.log(entity, rr.SeriesLines(names=names), static=True)

    def words(self, entity, said: Iterable[tuple[int, str, str]], iterations=None):
        steps, texts, levels = zip(*said, strict=True)
        columns = rr.TextLog.columns(text=list(texts), level=list(levels))
        self.stream.send_columns(entity, times(np.array(steps), iterations), columns)

    def static(self, entity, **values):
        self.stream.log(entity, rr.AnyValues(**values), static=True)

    def close(self) -> Path:
        self.stream.flush()
        self.stream.disconnect()
        return self.path

    def kill(self) -> Path:
        self.stream.flush()
        data = self.path.read_bytes()
        self.stream.disconnect()
        self.path.write_bytes(data)
        return self.path


def times(steps, iterations=None):
    columns = [
        rr.TimeColumn("step", sequence=steps),
        rr.TimeColumn("sim_time", duration=(np.asarray(steps) * STEP_DT * 1e9).round().astype("timedelta64[ns]")),
    ]
    if iterations is not None:
        columns.append(rr.TimeColumn("iteration", sequence=np.asarray(iterations)))
    return columns


def pitch(steps=STEPS):
    return AMPLITUDE * np.sin(4 * np.pi * np.arange(1, steps + 1) / steps)


def drive(writer: Writer, branch: str = "", offset: float = 0.0) -> None:
    at, rows = (f"{branch}/" if branch else ""), np.arange(1, STEPS + 1)
    fallen, over = rows == 50, rows == 150
    writer.numbers(f"{at}base/height", np.full(STEPS, 0.1 + offset))
    writer.numbers(f"{at}base/pitch", pitch())
    writer.numbers(f"{at}base/v_x", np.full(STEPS, 1.25))
    writer.numbers(f"{at}base/w_z", np.where(rows % 2, 0.5, -0.5))
    writer.numbers(f"{at}commands/drive/v_x", np.ones(STEPS))
    writer.numbers(f"{at}commands/drive/w_z", np.zeros(STEPS))
    writer.numbers(f"{at}rewards/alive", np.full(STEPS, 3.0))
    writer.numbers(f"{at}rewards/effort", np.full(STEPS, -1.0))
    writer.numbers(f"{at}rewards/total", np.full(STEPS, 2.0))
    writer.static(f"{at}rewards", terms=["effort", "alive"], weights=[-0.1, 3.0])
    writer.numbers(f"{at}terminations/fallen", fallen)
    writer.numbers(f"{at}terminations/time_out", over)
    writer.numbers(f"{at}contacts/feet", np.stack([rows, 0 * rows], axis=1), names=["left", "right"])
    writer.numbers(f"{at}joints/hip/effort", np.where(rows % 4, 1.0, -2.0))
    writer.static(f"{at}joints/hip", effort_limit=[2.0])
    writer.words(
        f"{at}log/episodes", [(50, "env 0: ended by fallen", "WARN"), (150, "env 0: ended by time_out", "INFO")]
    )
    writer.words(f"{at}log/events", [(30, "env 0: push", "INFO"), (120, "env 0: push", "INFO")])


def play(path: Path, **options) -> Path:
    writer = Writer(path, **options)
    drive(writer)
    return writer.close()


def training(path: Path, envs: Mapping[int, float] = {2: 0.0, 5: 1.0}) -> Path:
    writer = Writer(path)
    for env_id, offset in envs.items():
        drive(writer, f"env_{env_id}", offset)
    iterations = np.arange(10)
    writer.numbers("training/Train/mean_reward", 9.0 - (iterations - 6.0) ** 2, 20 * (iterations + 1), None, iterations)
    return writer.close()


def late(path: Path) -> Path:
    """Record a training whose first sample falls after 20 steps at height 1; the last stands 40 steps at height 2."""
    writer = Writer(path)
    steps = np.r_[1:21, 201:241, 301:311]
    iterations = (steps - 1) // 20
    writer.numbers("terminations/fallen", steps == 20, steps, None, iterations)
    writer.numbers("terminations/time_out", steps == 240, steps, None, iterations)
    writer.numbers("base/height", np.where(steps <= 20, 1.0, 2.0), steps, None, iterations)
    writer.numbers("rewards/total", np.where(steps == 20, -100.0, 1.0), steps, None, iterations)
    writer.words("log/episodes", [(20, "env 0: ended by fallen", "WARN"), (240, "env 0: ended by time_out", "INFO")])
    scalars = np.array([0.0, 5.0, 8.0])
    writer.numbers("training/Train/mean_reward", scalars, [20, 240, 320], None, [0, 11, 15])
    return writer.close()
