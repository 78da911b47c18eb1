"""Bodies that lie inside one another, by MuJoCo's own collision detection."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np

from wheelleg_exp.lint.collider_depth import colliders


@dataclass(frozen=True)
class Overlap:
    """Two bodies whose colliders overlap.

    Attributes:
        bodies: their names, the parent first.
        depth: how far one has to move to come free, m.
        neighbours: whether one hangs on the other by a joint.
        acts: whether the model lets them push each other apart.
    """

    bodies: tuple[str, str]
    depth: float
    neighbours: bool
    acts: bool


def find_overlaps(model: mujoco.MjModel, qpos: np.ndarray, names: Collection[str]) -> list[Overlap]:
    """Return the pairs of a robot's bodies that overlap at a pose, the deepest first.

    Bodies that are fixed to each other, or that the model excludes by name, are left out.

    Args:
        model: the robot, perhaps in its scene.
        qpos: the pose, (nq,).
        names: the robot's bodies.
    """
    bodies = {model.body(name).id for name in names}
    acting = set(_depths(model, qpos, bodies))
    pairs = sorted(_depths(_all_touching(model, bodies), qpos, bodies).items(), key=lambda item: -item[1])
    found = []
    for (one, other), depth in pairs:
        if model.body_weldid[one] == model.body_weldid[other]:
            continue
        names_of = model.body(one).name, model.body(other).name
        found.append(Overlap(names_of, depth, _neighbours(model, one, other), (one, other) in acting))
    return found


def _all_touching(model: mujoco.MjModel, bodies: set[int]) -> mujoco.MjModel:
    """Return the model with every collider of the robot able to touch every other, and nothing else."""
    free = copy.copy(model)
    solid = colliders(model, bodies)
    free.geom_contype[:] = free.geom_conaffinity[:] = 0
    free.geom_contype[solid] = free.geom_conaffinity[solid] = 1
    free.body_contype[:] = free.body_conaffinity[:] = 1
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    return free


def _depths(model: mujoco.MjModel, qpos: np.ndarray, bodies: set[int]) -> dict[tuple[int, int], float]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return overlap_depths(model, data, bodies)


def overlap_depths(model: mujoco.MjModel, data: mujoco.MjData, bodies: Collection[int]) -> dict[tuple[int, int], float]:
    """Return how deep bodies lie inside one another where the model lets them touch, m, by pair of their ids.

    Args:
        model: the robot, perhaps in its scene.
        data: its pose, with the contacts found.
        bodies: ids of the robot's bodies.
    """
    found: dict[tuple[int, int], float] = {}
    for contact in data.contact[: data.ncon]:
        one, other = sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)
        if one in bodies and other in bodies and contact.dist < 0:
            found[one, other] = max(found.get((one, other), 0.0), -float(contact.dist))
    return found


def _neighbours(model: mujoco.MjModel, one: int, other: int) -> bool:
    weld, parent = model.body_weldid, model.body_parentid
    ends = weld[one], weld[other]
    return bool(weld[parent[ends[0]]] == ends[1] or weld[parent[ends[1]]] == ends[0])
