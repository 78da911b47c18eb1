from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from inspection.synthetic import STEP_DT, Writer, times

DT = STEP_DT
STEPS = 60
FELL_AT = 40
SPEED = 0.5
HEIGHT = 0.2
TILE = 0.1
SAMPLES = (0, 5, 10)
ITERATION_STEPS = 24
ITERATIONS = 12
ORANGE, DARK = (240, 140, 20), (25, 25, 28)
CONTACT = 0.15

Columns = dict[str, np.ndarray]


def steps_of(*, training: bool) -> np.ndarray:
    if not training:
        return np.arange(1, STEPS + 1)
    return np.concatenate([ITERATION_STEPS * i + np.arange(1, STEPS + 1) for i in SAMPLES])


def base_x(steps: np.ndarray) -> np.ndarray:
    return SPEED * DT * ((steps - 1) % FELL_AT)


def numbers(steps: np.ndarray) -> Columns:
    time = steps * DT
    fell = ((steps - 1) % FELL_AT == FELL_AT - 1).astype(float)
    ones = np.ones(len(steps))
    return {
        "base/height": HEIGHT + 0.01 * np.sin(3 * time),
        "base/pitch": 0.1 * np.sin(2 * time),
        "base/roll": 0.0 * time,
        "base/v_x": SPEED + 0.05 * np.cos(5 * time),
        "base/w_z": 0.02 * np.sin(time),
        "commands/drive/v_x": SPEED * ones,
        "commands/drive/w_z": 0.0 * ones,
        "joints/knee/position": 0.3 + 0.1 * np.sin(time),
        "joints/knee/position_target": 0.3 * ones,
        "joints/knee/effort": 1.5 * np.sin(4 * time),
        "joints/roll/velocity": 5.0 + np.sin(time),
        "joints/roll/velocity_target": 5.0 * ones,
        "joints/roll/effort": 0.3 * np.cos(4 * time),
        "rewards/alive": 2.0 * ones,
        "rewards/effort": -0.5 * np.sin(4 * time) ** 2,
        "rewards/total": 2.0 - 0.5 * np.sin(4 * time) ** 2,
        "terminations/fell": fell,
        "terminations/time_out": 0.0 * ones,
    }


def write_recording(path: Path, *, env_ids: Sequence[int] = (0,), training: bool = False, tile: bool = False) -> Path:
    writer, steps = Writer(path, recording_id=path.stem), steps_of(training=training)
    iterations = (steps - 1) // ITERATION_STEPS if training else None
    told = {"format_version": 2, "purpose": "training" if training else "play", "env_ids": list(env_ids), "step_dt": DT}
    writer.stream.send_property("wheelleg", rr.AnyValues(**told))
    writer.stream.send_property("robot", rr.AnyValues(root="base", bodies=["base", "wheel"], height=0.28))
    writer.stream.send_recording_name(path.stem)
    for place, env_id in enumerate(env_ids):
        branch = f"env_{env_id}/" if len(env_ids) > 1 else ""
        for entity, column in numbers(steps).items():
            name = entity.split("/")[-1]
            writer.numbers(f"{branch}{entity}", column + 0.001 * place, steps, [name], iterations)
        forces = np.column_stack((0.0 * steps, 20.0 * (steps % 2)))
        writer.numbers(f"{branch}contacts/feet", forces, steps, ["base", "wheel"], iterations)
        writer.static(f"{branch}rewards", terms=["effort", "alive"])
        writer.static(f"{branch}joints/knee", effort_limit=2.0, stiffness=3.0)
        writer.static(f"{branch}joints/roll", effort_limit=9.0, stiffness=0.0)
        _bodies(writer.stream, branch, steps, times(steps, iterations))
        if tile:
            writer.static(f"{branch}state", origin=[2.0 * place, 0.0, 0.0])
    if tile:
        block = rr.Boxes3D(half_sizes=[[0.5, 0.5, 0.01]], centers=[[2.0, 0.0, -0.01]])
        writer.stream.log("ground/terrain/ground/0_0", block, static=True)
    square = TILE * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    ground = rr.Mesh3D(vertex_positions=square, triangle_indices=[[0, 1, 2], [0, 2, 3]])
    writer.stream.log("ground", ground, static=True)
    first = times(steps[:1], None if iterations is None else iterations[:1])
    writer.stream.send_columns("ground", first, rr.Transform3D.columns(translation=[[0.0, 0.0, 0.0]]))
    if training:
        done = np.arange(ITERATIONS)
        for key, values in scalar_values().items():
            writer.numbers(f"training/{key}", values, ITERATION_STEPS * (done + 1), None, done)
    return writer.close()


def _bodies(stream: rr.RecordingStream, branch: str, steps: np.ndarray, moments: list) -> None:
    base, wheel = f"world/{branch}base", f"world/{branch}wheel"
    stream.log(f"{base}/shell", rr.Boxes3D(half_sizes=[[0.08, 0.06, 0.05]], colors=[ORANGE]), static=True)
    stream.log(f"{base}/eye", rr.Ellipsoids3D(half_sizes=[[0.02, 0.02, 0.02]], centers=[[0.08, 0, 0]]), static=True)
    rod = rr.Capsules3D(lengths=[0.1], radii=[0.01], translations=[[0, 0, -0.1]], colors=[DARK])
    stream.log(f"{base}/rod", rod, static=True)
    corners = np.array([[0, 0, 0.09], [0.03, 0, 0.05], [-0.03, 0.03, 0.05], [-0.03, -0.03, 0.05]])
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    stream.log(f"{base}/fin", rr.Mesh3D(vertex_positions=corners, triangle_indices=faces), static=True)
    lying = [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    tyre = rr.Cylinders3D(lengths=[0.03], radii=[0.05], centers=[[0, 0, 0]], quaternions=[lying], colors=[DARK])
    stream.log(f"{wheel}/tyre", tyre, static=True)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(steps), 1))
    for entity, height in ((base, HEIGHT), (wheel, 0.05)):
        where = np.column_stack((base_x(steps), 0.0 * steps, np.full(len(steps), height)))
        stream.send_columns(entity, moments, rr.Transform3D.columns(translation=where, quaternion=upright))
    touching = steps % 2 == 1
    origins = np.column_stack((base_x(steps), np.full(len(steps), -0.15), np.full(len(steps), 0.05)))[touching]
    arrows = rr.Arrows3D.columns(origins=origins, vectors=np.tile([0.0, 0.0, CONTACT], (len(origins), 1)))
    overlay = f"overlay/{branch}contacts/feet"
    stream.log(overlay, rr.Arrows3D.from_fields(colors=[(255, 0, 255)], radii=[0.003]), static=True)
    stream.send_columns(overlay, moments, arrows.partition(touching.astype(int)))


def scalar_values() -> Columns:
    i = np.arange(ITERATIONS)
    return {
        "Train/mean_reward": i**1.5,
        "Train/mean_episode_length": 10.0 + i,
        "Loss/value": np.exp(-i / 4),
        "Loss/learning_rate": 1e-3 * np.ones(ITERATIONS),
        "Policy/mean_std": 1 - i / 50,
        "Episode_Reward/alive": 2.0 * np.ones(ITERATIONS),
        "Episode_Reward/effort": -0.5 - i / 100,
        "Episode_Termination/fell": 1 - i / 20,
        "Episode_Termination/time_out": i / 20,
    }
