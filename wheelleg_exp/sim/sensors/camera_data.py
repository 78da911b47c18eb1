"""What cameras measure, in Isaac Lab's names, and the conventions of their frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import torch

from wheelleg_exp.constraints import Broken
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.sensors.mounting import Offset, offset_fits
from wheelleg_exp.sim.sensors.patterns import PinholePattern
from wheelleg_exp.state import Kept

Convention = Literal["world", "ros", "opengl"]
CameraOffset = Mapping[Literal["pos", "rot", "convention"], Sequence[float] | Convention]
DepthClipping = Literal["max", "zero", "none"]
DEPTHS = ("depth", "distance_to_image_plane", "distance_to_camera")
# The axes of each convention seen from the first: (w, x, y, z).
_FROM_WORLD: dict[str, tuple[float, float, float, float]] = {
    "world": (1.0, 0.0, 0.0, 0.0),  # looks along x, up is z
    "ros": (0.5, -0.5, 0.5, -0.5),  # looks along z, up is -y
    "opengl": (0.5, 0.5, -0.5, -0.5),  # looks along -z, up is y
}


class CameraData(Kept):
    """What a camera has measured.

    Attributes:
        pos_w: the camera's position, m, (N, 3).
        quat_w_world: its orientation, axes x forward, y left, z up, (w, x, y, z), (N, 4).
        image_shape: rows and columns of a picture.
        intrinsic_matrices: px, (N, 3, 3): a point (x right, y down, z forward) is seen at (fx x/z + cx, fy y/z + cy);
            the first pixel reaches from 0 to 1.
        output: pictures by data type, (N, height, width, channels).
        info: what the numbers of a segmentation stand for, ``info[data_type]["idToLabels"]``.
    """

    def __init__(self, num_envs: int, pinhole: PinholePattern, device: torch.device) -> None:
        self.pos_w = torch.zeros(num_envs, 3, device=device)
        self.quat_w_world = torch.zeros(num_envs, 4, device=device)
        self.image_shape = (pinhole.height, pinhole.width)
        self.intrinsic_matrices = torch.tensor(pinhole.intrinsics, device=device).repeat(num_envs, 1, 1)
        self.output: dict[str, torch.Tensor] = {}
        self.info: dict[str, dict[str, dict[int, str]]] = {}

    @property
    def quat_w_ros(self) -> torch.Tensor:
        """Orientation, axes x right, y down, z forward, (w, x, y, z), (N, 4)."""
        return convert_convention(self.quat_w_world, "world", "ros")

    @property
    def quat_w_opengl(self) -> torch.Tensor:
        """Orientation, axes x right, y up, z backward, (w, x, y, z), (N, 4)."""
        return convert_convention(self.quat_w_world, "world", "opengl")

    def add_output(self, data_type: str, channels: int, dtype: torch.dtype) -> None:
        """Make room for one kind of pictures."""
        size = (len(self.pos_w), *self.image_shape, channels)
        self.output[data_type] = torch.zeros(size, dtype=dtype, device=self.pos_w.device)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what has been measured."""
        return {
            "pos_w": self.pos_w.clone(),
            "quat_w_world": self.quat_w_world.clone(),
            **{f"output.{name}": value.clone() for name, value in self.output.items()},
        }

    def load_state_dict(self, saved: Mapping[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        self.pos_w.copy_(saved["pos_w"])
        self.quat_w_world.copy_(saved["quat_w_world"])
        for name, value in self.output.items():
            value.copy_(saved[f"output.{name}"])


def camera_offset_fits(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold a camera's ``offset`` against its form."""
    yield from offset_fits(given)
    convention = (given["offset"] or {}).get("convention", "ros")
    if convention not in _FROM_WORLD:
        yield Broken("offset.convention", f"{convention!r} is no convention", "one of " + ", ".join(_FROM_WORLD))


def in_world_convention(offset: CameraOffset | None) -> Offset:
    """Return an offset whose ``rot`` turns axes x forward, y left, z up; ``ros`` is taken where none is told."""
    given: Mapping[Any, Any] = offset or {}
    rot = torch.tensor([given.get("rot", (1.0, 0.0, 0.0, 0.0))], dtype=torch.float32, device="cpu")
    convention: Convention = given.get("convention", "ros")
    turned: list[float] = convert_convention(rot, convention, "world")[0].tolist()
    return {"pos": list(given.get("pos", (0.0, 0.0, 0.0))), "rot": turned}


def opengl_quat(offset: Offset) -> list[float]:
    """Return the orientation (w, x, y, z) of a world-convention offset as MuJoCo's cameras have it."""
    quat: list[float] = convert_convention(torch.tensor([offset["rot"]], device="cpu"), "world", "opengl")[0].tolist()
    return quat


def clipped(depth: torch.Tensor, farthest: float, behavior: DepthClipping) -> torch.Tensor:
    """Return distances, m, with what is farther (or nothing) inf, 0 or the farthest distance, as Isaac Lab's."""
    instead = {"none": math.inf, "zero": 0.0, "max": farthest}[behavior]
    return depth.masked_fill(depth > farthest, instead)


def convert_convention(quat: torch.Tensor, origin: Convention, target: Convention) -> torch.Tensor:
    """Return the same orientations (n, 4), (w, x, y, z), by the axes of another convention."""
    w, x, y, z = _FROM_WORLD[origin]
    back, there = (
        torch.tensor(axes, dtype=quat.dtype, device=quat.device).expand_as(quat)
        for axes in ((w, -x, -y, -z), _FROM_WORLD[target])
    )
    return rotation.quat_mul(rotation.quat_mul(quat, back), there)
