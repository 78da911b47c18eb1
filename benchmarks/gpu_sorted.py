"""Sort the contacts and constraint rows of mujoco-warp, so that their order does not depend on thread timing.

If ``opt.deterministic`` is set, mujoco-warp 4.0 calls two sort functions that do nothing. For the benchmark
``gpu_repeat.py``, this module implements the two functions with torch. Contacts are sorted by world, geom pair and
number within the pair; the rows of a world by type and object. The rows of one contact stay adjacent.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch

_LAST = torch.iinfo(torch.int64).max
_ROW_FIELDS = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss", "Jqvel", "J")
_GEOMS, _PER_PAIR = 1 << 16, 1 << 8


def fill_the_sorts(wp: ModuleType) -> None:
    """Replace the empty sort functions of mujoco-warp."""
    from mujoco_warp._src import collision_driver, constraint

    def tensor(array: Any) -> torch.Tensor:
        view: torch.Tensor = wp.to_torch(array)
        return view

    def sort_contacts(model: Any, data: Any) -> None:
        del model
        contact = data.contact
        geom, world = tensor(contact.geom).long(), tensor(contact.worldid).long()
        pair = (geom[:, 0] + 1) * _GEOMS + geom[:, 1] + 1
        # Sort twice, because one key cannot contain world and geoms; the second sort is stable.
        key = pair * _PER_PAIR + tensor(contact.geomcollisionid)
        used = torch.arange(len(world), device=world.device) < tensor(data.nacon)
        first = torch.argsort(key, stable=True)
        world = torch.where(used, world, world.new_full((), _LAST))
        order = first[torch.argsort(world[first], stable=True)]
        for name, array in vars(contact).items():
            if isinstance(array, wp.array) and name != "efc_address" and array.size and array.shape[0] == len(order):
                values = tensor(array)
                values.copy_(values[order])

    def sort_rows(model: Any, data: Any) -> None:
        if model.is_sparse:
            raise NotImplementedError("the rows of a sparse Jacobian cannot be sorted")
        efc = data.efc
        count, rows = tensor(data.nefc).long().view(-1, 1), efc.type.shape[1]
        index = torch.arange(rows, device=count.device).expand(len(count), rows)
        key = ((tensor(efc.type).long() << 40) + tensor(efc.id).long()) * rows
        # The rows of one contact or one equality are already adjacent and in order.
        order = torch.argsort(torch.where(index < count, key, _LAST), dim=1, stable=True)
        place = torch.empty_like(order).scatter_(1, order, index)
        for name in _ROW_FIELDS:
            values = tensor(getattr(efc, name))
            by = order.view(*order.shape, *[1] * (values.ndim - 2)).expand(-1, -1, *values.shape[2:])
            values[:, :rows].copy_(values[:, :rows].gather(1, by))
        _blocks(tensor(efc.jtdaj_adr), tensor(efc.jtdaj_nrow), tensor(efc.jtdaj_nblock).view(-1, 1), place)
        address, world = tensor(data.contact.efc_address), tensor(data.contact.worldid).long()
        has = (address >= 0) & (torch.arange(len(world), device=world.device) < tensor(data.nacon)).view(-1, 1)
        moved = place[world.clamp(0, len(count) - 1).view(-1, 1), address.long().clamp(min=0)]
        address.copy_(torch.where(has, moved.to(address.dtype), address))

    collision_driver._sort_contacts, constraint._sort_constraints = sort_contacts, sort_rows


def _blocks(address: torch.Tensor, rows: torch.Tensor, count: torch.Tensor, place: torch.Tensor) -> None:
    """Move the row blocks in the order of their sorted rows."""
    used = torch.arange(address.shape[1], device=address.device) < count
    moved = place.gather(1, address.long().clamp(0, place.shape[1] - 1))
    order = torch.argsort(torch.where(used, moved, _LAST), dim=1, stable=True)
    rows.copy_(rows.gather(1, order))
    address.copy_(torch.where(used, moved.gather(1, order).to(address.dtype), address))
