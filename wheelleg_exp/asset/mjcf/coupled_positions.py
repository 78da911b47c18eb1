"""Joints that follow other joints: MuJoCo's joint equalities, to which the converter converts mimic joints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

RANK = 1e-4  # Constraints are redundant if their rows differ by less than this share of the largest row.
Positions = TypeVar("Positions", NDArray[np.float64], "torch.Tensor")
_SAMPLES = 10001  # positions of a driver, among which its limits are found


class JointCouplings:
    """The active joint equalities of a model: q - ref = c0 + c1·r + c2·r² + c3·r³ + c4·r⁴, with r = driver - its ref.

    ``columns`` maps joint ids to columns of position arrays, by default those of qpos. Each of ``rows`` contains the
    columns of a follower and its driver, their ref, rad (m), and c0 to c4, in the order of a chain. ``limits`` maps a
    driver's column to the range around its ref, rad (m), in which all followers are inside their own limits.
    """

    def __init__(self, model: mujoco.MjModel, columns: Mapping[int, int] | None = None) -> None:
        of = dict(enumerate(model.jnt_qposadr.tolist())) if columns is None else columns
        drivers, terms = dict[int, int](), dict[int, list[float]]()
        for index in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 != 0)):
            joint, driver = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            drivers[joint], terms[joint] = driver, model.eq_data[index, :5].tolist()
            if driver < 0:  # The joint has the constant position ref + c0.
                drivers[joint], terms[joint] = joint, [terms[joint][0], 0.0, 0.0, 0.0, 0.0]
        chains = {joint: [joint] for joint in drivers}  # Each chain ends at a driver that follows no other joint.
        for chain in chains.values():
            while (driver := drivers.get(chain[-1], chain[-1])) not in chain:
                chain.append(driver)
        self.followers, ref = set(drivers), model.qpos0[model.jnt_qposadr].tolist()
        ordered = sorted(drivers, key=lambda joint: len(chains[joint]))
        self.rows = [(of[j], of[drivers[j]], ref[j], ref[drivers[j]], terms[j]) for j in ordered]
        self.limits: dict[int, tuple[float, float]] = {}
        for driver in {chain[-1] for chain in chains.values()} - self.followers:
            moved = [driver, *(joint for joint, chain in chains.items() if chain[-1] == driver)]
            limited = [joint for joint in moved if model.jnt_limited[joint]]
            span = model.jnt_range[driver] if driver in limited else ref[driver] + np.array([-math.pi, math.pi])
            places = np.union1d(np.linspace(span[0], span[1], _SAMPLES), np.clip(ref[driver], *span))
            poses = np.zeros((len(places), 1 + max(of.values())))
            poses[:, of[driver]] = places
            self.follow(poses)
            low, high = model.jnt_range[limited].T
            reached = poses[:, [of[joint] for joint in limited]]
            fits = np.flatnonzero(((reached > low - 1e-9) & (reached < high + 1e-9)).all(axis=1))
            if 0 < len(fits) < len(places):
                runs = np.split(fits, np.flatnonzero(np.diff(fits) > 1) + 1)
                near = min(runs, key=lambda run: np.abs(places[run] - ref[driver]).min())
                self.limits[of[driver]] = float(places[near[0]]), float(places[near[-1]])

    def follow(self, positions: Positions, velocities: Positions | None = None) -> None:
        """Set the followers in ``positions`` (..., columns), rad (m), and ``velocities`` to what their drivers require.

        The arguments are numpy arrays or torch tensors, and change in place. Drivers first move into their ``limits``.
        """
        for column, (low, high) in self.limits.items():
            positions[..., column] = positions[..., column].clip(low, high)
        for follower, driver, ref, start, (a, b, c, d, e) in self.rows:
            r = positions[..., driver] - start
            positions[..., follower] = ref + a + r * (b + r * (c + r * (d + r * e)))
            if velocities is not None:
                velocities[..., follower] = velocities[..., driver] * (b + r * (2 * c + r * (3 * d + r * 4 * e)))


def constraint_rows(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return orthogonal rows (r, nv): couplings and closed loops make their products with the velocities 0."""
    columns = np.zeros((model.nv, data.nefc))
    for column, velocity in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulJacVec(model, data, column, velocity)
    _, sizes, rows = np.linalg.svd(columns.T[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY])
    # Several rows often describe one constraint, up to rounding errors of the file.
    return rows[: np.count_nonzero(sizes > RANK * sizes.max(initial=0.0))]
