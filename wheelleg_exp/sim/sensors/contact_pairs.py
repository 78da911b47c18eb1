"""Contacts of each sensed body with each of some others, as MuJoCo's sensors tell them."""

from __future__ import annotations

import mujoco
import torch

FIELDS = ("found", "force", "pos", "normal", "tangent")  # in MuJoCo's order; force in the contact's frame, normal first
_SIZES = {"found": 1, "force": 3, "pos": 3, "normal": 3, "tangent": 3}
NORMAL = ("found", "force", "normal")  # what the normal forces alone need


def data_flags(fields: tuple[str, ...]) -> int:
    """Return what a MuJoCo contact sensor is told to report."""
    return sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name.upper()}")) for name in fields)


def width(fields: tuple[str, ...]) -> int:
    """Return how many numbers it reports of a contact."""
    return sum(_SIZES[name] for name in fields)


def summed(pressures: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Return pressures (N, B, 1, S) times normals (N, B, S, 3), added up over contacts, (N, B, 3)."""
    if pressures.is_cuda:  # thousands of tiny products take a GPU's library ten times as long as their sum
        return (pressures.transpose(2, 3) * normals).sum(dim=2)
    return torch.matmul(pressures, normals).squeeze(2)


class ContactPairs:
    """Reads the contacts of B sensed bodies with M others. The normal points away from the sensed body.

    Args:
        readings: numbers of all contacts, (N, B * M, S, W), which the engine writes.
        bodies: the number of sensed bodies, B.
        fields: what is reported, some of ``FIELDS``.
    """

    def __init__(self, readings: torch.Tensor, bodies: int, fields: tuple[str, ...]) -> None:
        parts = torch.split(readings, [_SIZES[name] for name in fields], dim=-1)
        self._parts = dict(zip(fields, parts, strict=True))
        self._bodies = bodies

    def normal_forces(self) -> torch.Tensor:
        """Return the normal force on each body from each other one, N, (N, B, M, 3), world axes."""
        pressures = self._parts["force"][..., 0].unsqueeze(2)
        return self._of_pairs(summed(pressures, self._parts["normal"]).neg_())

    def friction_forces(self) -> torch.Tensor:
        """Return the friction on each body from each other one, N, (N, B, M, 3), world axes."""
        tangent = self._parts["tangent"]
        across = torch.linalg.cross(self._parts["normal"], tangent)
        _, along, aside = self._parts["force"].split(1, dim=-1)
        return self._of_pairs((along * tangent + aside * across).sum(dim=2).neg_())

    def points(self) -> torch.Tensor:
        """Return the mean place of the contacts, m, (N, B, M, 3), world axes; NaN where there is none."""
        count = (self._parts["found"] > 0.0).sum(dim=2)
        return self._of_pairs(self._parts["pos"].sum(dim=2) / count)  # a place without a contact holds zeros

    def _of_pairs(self, values: torch.Tensor) -> torch.Tensor:
        return values.float().view(len(values), self._bodies, -1, 3)
