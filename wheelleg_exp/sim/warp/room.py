"""How many contacts and constraint rows there is room for, and the error when there are more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import SimulationFailure

_CONTACTS = 24  # a simulation, on average: a wheel-legged robot that lies on the ground has about twelve
_ON_RELIEF = 48  # a height field or a mesh meets one geom in several points
_GRAIN = 16
_ROWS_OF_EQUALITY = 6


@dataclass(frozen=True)
class Room:
    """What a simulation has room for.

    Attributes:
        contacts: contacts; all simulations share the room of all.
        rows: constraint rows; each simulation has its own.
    """

    contacts: int
    rows: int


def room_for(model: mujoco.MjModel, nconmax: int, njmax: int) -> Room:
    """Return the room for a model; 0 is worked out of it: contacts of a robot on the ground, and rows for them.

    Args:
        model: the compiled scene.
        nconmax: contacts a simulation, or 0.
        njmax: constraint rows a simulation, or 0.
    """
    uneven = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_MESH))
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    relief = bool((np.isin(model.geom_type, uneven) & solid).any())
    contacts = nconmax or (_ON_RELIEF if relief else _CONTACTS)
    if njmax:
        return Room(contacts, njmax)
    rows_of_contact = 2 * (int(model.geom_condim.max(initial=3)) - 1)  # of a pyramid, the larger of both cones
    rows = contacts * rows_of_contact + model.neq * _ROWS_OF_EQUALITY
    rows += int((model.jnt_limited != 0).sum()) + int((model.dof_frictionloss != 0).sum())
    rows += int((model.tendon_limited != 0).sum()) + int((model.tendon_frictionloss != 0).sum())
    return Room(contacts, -(-rows // _GRAIN) * _GRAIN)


class Overflow:
    """Notices that there were more contacts or constraint rows than there is room for, without waiting for a GPU.

    Args:
        kinds: mujoco-warp's enumeration of overflows.
        flags: its flags of each simulation, (N,) int, a live view; nobody clears them.
        room: what there is room for.
    """

    def __init__(self, kinds: Any, flags: torch.Tensor, room: Room) -> None:
        self._flags, self._room = flags, room
        self._rows = int(kinds.NEFC | kinds.NJMAX_NNZ)
        self._contacts = int(kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD)
        self._seen = torch.zeros((), dtype=flags.dtype, device="cpu", pin_memory=flags.is_cuda)

    def look(self) -> None:
        """Ask for the flags of now; ``require_none`` knows of them as soon as they have come."""
        lost = self._flags & (self._rows | self._contacts)
        self._seen.copy_(lost.amax(), non_blocking=True)

    def require_none(self, data: Any) -> None:
        """Raise SimulationFailure when flags have come that say so.

        Args:
            data: mujoco-warp's data, whose counts are told.
        """
        if not int(self._seen):
            return
        flags = int(self._seen)
        if flags & self._rows:
            key, has, needed = "env.sim.njmax", self._room.rows, int(data.nefc.numpy().max())
            what = "constraint rows in one simulation"
        else:
            found = max(int(data.nacon.numpy()[0]), int(data.ncollision.numpy()[0]))
            key, has, needed = "env.sim.nconmax", self._room.contacts, -(-found // int(data.nworld))
            what = "contacts a simulation on average"
        raise SimulationFailure(
            f"there are more than {has} {what}, and those beyond are lost",
            key=key,
            expected=f"{max(needed, 2 * has)} or more",
        )
