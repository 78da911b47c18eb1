"""The faults that a robot's log can have: each is a model of how the log shows the robot, with a name and advice."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from wheelleg_exp.robot_logs.log_simulation import MOST_LAG, Sensing, channels

_SCALES = (0.5, 0.8, 0.9, 1.1, 1.25, 2.0)
_GAINS = (0.5, 0.7, 0.85, 1.2, 1.5, 2.0)
_ANGLES = (-0.3, -0.1, -0.03, 0.03, 0.1, 0.3)  # rad
_RATES = (-0.3, -0.1, -0.04, 0.04, 0.1, 0.3)  # rad/s
_TILTS = (-0.2, -0.06, -0.02, 0.02, 0.06, 0.2)  # of a unit vector
_UNITS = {
    "joint_pos": (("degrees", 180 / np.pi), ("revolutions", 0.5 / np.pi)),
    "joint_vel": (("degrees per second", 180 / np.pi), ("rpm", 30 / np.pi), ("revolutions per second", 0.5 / np.pi)),
    "base_ang_vel": (("degrees per second", 180 / np.pi),),
    "projected_gravity": (("m/s²", 9.81),),
}
_SI = {"joint_pos": "rad", "joint_vel": "rad/s", "base_ang_vel": "rad/s", "projected_gravity": "a unit vector"}


@dataclass(frozen=True)
class Fault:
    """One possible fault: its kind, such as ``sign``, the log's columns, what is wrong, and what to change.

    ``model`` returns the sensing model for a ``value``, such as a scale, which is fitted to the log if ``is_fitted``;
    ``{value}`` in the texts stands for it. A value within ``least`` of ``neutral`` is not a fault.
    """

    kind: str
    columns: tuple[str, ...]
    wrong: str
    change: str
    model: Callable[[float], Sensing]
    value: float = 0.0
    is_fitted: bool = False
    neutral: float = 0.0
    least: float = 0.0

    @property
    def sensing(self) -> Sensing:
        return self.model(self.value)

    def nearby(self, spread: float) -> list[Fault]:
        """Return the fault with eight values around its present value, up to ``spread`` times its distance from it."""
        away = self.value - self.neutral
        return [replace(self, value=self.neutral + away * factor) for factor in 1 + np.linspace(-spread, spread, 9)]


class _Maker:
    def __init__(self, joint_names: Sequence[str]) -> None:
        self.names, self.channels = list(joint_names), channels(joint_names)
        self.none = Sensing.identity(1, len(self.channels), len(joint_names))

    def scaled(self, columns: Sequence[str]) -> Callable[[float], Sensing]:
        return lambda value: self.turned(columns, np.eye(len(columns)) * value)

    def turned(self, columns: Sequence[str], block: np.ndarray) -> Sensing:
        """Return the model in which ``block`` (k, k) maps the true values of k columns to the logged values."""
        ids, matrix = [self.channels.index(column) for column in columns], self.none.matrix.copy()
        matrix[0, np.ix_(ids, ids)[0], np.ix_(ids, ids)[1]] = block
        return replace(self.none, matrix=matrix)

    def moved(self, column: str) -> Callable[[float], Sensing]:
        unit = np.array([[float(name == column) for name in self.channels]])
        return lambda value: replace(self.none, offset=unit * value)

    def late(self, columns: Sequence[str]) -> Callable[[float], Sensing]:
        which = np.array([[name in columns for name in self.channels]])
        return lambda value: replace(self.none, lag=which * int(value))

    def driven(self, joints: Sequence[str]) -> Callable[[float], Sensing]:
        which = np.array([[float(name in joints) for name in self.names]])
        return lambda value: replace(self.none, gain=1 + which * (value - 1))


def possible_faults(
    joint_names: Sequence[str], rolling: Sequence[str], groups: Sequence[Sequence[str]]
) -> Iterator[Fault]:
    """Yield the faults that are tried on the log of a robot.

    The encoders of ``rolling`` joints count from the start, so they have no offset. ``groups`` are the actuator groups.
    """
    make, imu = _Maker(joint_names), {name: [f"{name}.{axis}" for axis in "xyz"] for name in _UNITS}
    joints = {reading: [f"{reading}.{name}" for name in joint_names] for reading in ("joint_pos", "joint_vel")}
    yield from _joint_faults(make, joint_names, rolling, joints)
    for reading, units in _UNITS.items():
        columns = joints.get(reading) or imu[reading]
        for unit, factor in units:
            wrong, change = f"the readings {reading} are in {unit}", f"convert {reading} to {_SI[reading]}"
            yield Fault("unit", tuple(columns), wrong, change, make.scaled(columns), factor)
    gyro, gravity = imu["base_ang_vel"], imu["projected_gravity"]
    yield from _scales(make, gyro, "the gyroscope")
    for column, values in [(c, _RATES) for c in gyro] + [(c, _TILTS) for c in gravity[:2]]:
        tilted = "the IMU is tilted, or the centre of mass is not where it is simulated"
        what = "the gyroscope has a bias" if column in gyro else tilted
        change = f"subtract {{value:.3g}} from {column}, or calibrate the IMU"
        change += "" if column in gyro else "; if the IMU is right, correct the mass and its centre"
        for value in values:
            wrong = f"{what}: {column} is {{value:+.3g}} too high"
            yield Fault("offset", (column,), wrong, change, make.moved(column), value, True, 0.0, 0.02)
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        axes = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.array_equal(axes, np.eye(3)):
            continue
        words = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes]
        text = f"({', '.join(words)})"
        for columns, what in ((gyro, "base_ang_vel"), (gravity, "projected_gravity"), (gyro + gravity, "the IMU")):
            block = np.kron(np.eye(len(columns) // 3), axes)
            inverted = np.array_equal(axes, -np.eye(3)) and columns == gravity
            wrong = f"{what} is in another frame: its x, y, z are the base's {text}"
            wrong = "gravity is inverted: it points up" if inverted else wrong
            change = f"rotate {what} to the base's axes: x forwards, y to the left, z up"
            model = lambda _, columns=columns, block=block: make.turned(columns, block)  # noqa: E731
            yield Fault("frame", tuple(columns), wrong, change, model)
    every = [*joints["joint_pos"], *joints["joint_vel"]]
    for columns, what in ((every, "joint readings"), (gyro + gravity, "IMU readings"), (make.channels, "readings")):
        for lag in range(1, MOST_LAG):
            wrong = f"the {what} respond {lag} control step{'s' if lag > 1 else ''} later to the targets than simulated"
            change = "remove the delay of sensors, bus, or drives, or train with it (env.actions.<term>.delay)"
            yield Fault("delay", tuple(columns), wrong, change, make.late(columns), lag)
    drives = dict.fromkeys(tuple(names) for names in [*([name] for name in joint_names), *groups, joint_names])
    for names in drives:
        wrong = f"the drives of {', '.join(names)} respond with {{value:.3g}} times the gains of the simulation"
        change = "set stiffness and damping of the drives to those of policy.json, or train with the drives' gains"
        for value in _GAINS:
            driven = tuple(f"joint_pos.{name}" for name in names)
            yield Fault("gain", driven, wrong, change, make.driven(names), value, True, 1.0, 0.07)
        wrong = f"the drives of {', '.join(names)} act against their targets"
        if len(names) == 1:
            yield Fault("sign", names, wrong, "invert the motor's direction", make.driven(names), -1.0)


def _joint_faults(
    make: _Maker, joint_names: Sequence[str], rolling: Sequence[str], joints: dict[str, list[str]]
) -> Iterator[Fault]:
    both = list(joints)
    for name in joint_names:
        for readings in ([both[0]], [both[1]], both):
            columns = tuple(f"{reading}.{name}" for reading in readings)
            wrong, change = f"{' and '.join(columns)} have the wrong sign", f"multiply {' and '.join(columns)} by -1"
            yield Fault("sign", columns, wrong, change, make.scaled(columns), -1.0)
            if len(columns) == 1:
                yield from _scales(make, columns, columns[0])
        if name not in rolling:
            column = f"joint_pos.{name}"
            wrong = f"the encoder of {name} reads {{value:+.3g}} rad too much"
            change = f"subtract {{value:.3g}} rad from {column}"
            for value in _ANGLES:
                yield Fault("offset", (column,), wrong, change, make.moved(column), value, True, 0.0, 0.01)
    for one, other in combinations(joint_names, 2):
        for readings in ([both[0]], [both[1]], both):
            columns = tuple(f"{reading}.{name}" for reading in readings for name in (one, other))
            what = "all readings" if len(readings) == 2 else readings[0]
            wrong = f"{what} of the joints {one} and {other} are exchanged"
            block = np.kron(np.eye(len(readings)), [[0.0, 1.0], [1.0, 0.0]])
            model = lambda _, columns=columns, block=block: make.turned(columns, block)  # noqa: E731
            yield Fault("order", columns, wrong, f"exchange {what} of {one} and {other}", model)


def _scales(make: _Maker, columns: Sequence[str], what: str) -> Iterator[Fault]:
    for value in _SCALES:
        wrong, change = f"{what} reads {{value:.3g}} times the true value", f"divide {what} by {{value:.3g}}"
        yield Fault("scale", tuple(columns), wrong, change, make.scaled(columns), value, True, 1.0, 0.05)
