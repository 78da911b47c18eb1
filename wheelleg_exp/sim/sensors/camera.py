"""A camera that MuJoCo's renderer draws: colours, distances and what each pixel belongs to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import mujoco
import torch

from wheelleg_exp.constraints import Broken, Count, NonNegative, NotEmpty, Positive, PositiveInterval, relation
from wheelleg_exp.rendering.camera_job import Layer
from wheelleg_exp.rendering.camera_pictures import CameraPictures
from wheelleg_exp.rendering.limits import too_many
from wheelleg_exp.rendering.renderer import NoGraphics
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.sensors.camera_data import (
    DEPTHS,
    CameraData,
    CameraOffset,
    DepthClipping,
    camera_offset_fits,
    clipped,
    in_world_convention,
    opengl_quat,
)
from wheelleg_exp.sim.sensors.lazy import LazySensor
from wheelleg_exp.sim.sensors.mounting import Mount, offset_pose
from wheelleg_exp.sim.sensors.patterns import PinholePattern
from wheelleg_exp.sim.terrain import is_ground

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot

DataType = Literal[
    "rgb",
    "rgba",
    "depth",
    "distance_to_image_plane",
    "distance_to_camera",
    "semantic_segmentation",
    "instance_segmentation_fast",
    "instance_id_segmentation_fast",
]
_LAYERS: dict[str, Layer] = {"rgb": "colour", "rgba": "colour", **dict.fromkeys(DEPTHS, "depth")}
_BACKGROUND = "BACKGROUND"


def _range_of_angles(given: Mapping[str, Any]) -> Iterator[Broken]:
    if given["fovy"] is not None and given["fovy"] >= math.pi:
        yield Broken("fovy", f"{given['fovy']!r} is half a turn or more", "an angle in radians below pi")
    if given["clipping_range"][0] == given["clipping_range"][1]:
        yield Broken("clipping_range", "has no depth", "[nearest, farthest] in m")


@relation(_range_of_angles)
@relation(camera_offset_fits)
class Camera(LazySensor):
    """A camera on a body, drawn by MuJoCo for one environment after another; as Isaac Lab's, for a few of them.

    It needs a driver that draws without a display (EGL or OSMesa), from the first reading on. An environment's picture
    shows its own robot and the ground. Colours come from the compiled model and its lights; with the same driver the
    same state gives the same picture.

    Args:
        body_name: expression of the body.
        width: px.
        height: px.
        data_types: what is drawn: ``rgb`` (uint8, 3 channels), ``rgba``, ``distance_to_image_plane`` or ``depth`` (m,
            along the axis), ``distance_to_camera`` (m, along the pixel's ray), ``semantic_segmentation`` (ground or
            robot), ``instance_segmentation_fast`` (bodies), ``instance_id_segmentation_fast`` (geoms), int32.
        offset: ``pos``, m, (x, y, z), and ``rot``, (w, x, y, z), in the body's frame, of axes that ``convention``
            names: ``world`` looks along x, up is z; ``ros`` along z, up is -y; ``opengl`` along -z, up is y.
        focal_length: in the unit of the apertures; only their ratio counts.
        horizontal_aperture: width of the image plane.
        vertical_aperture: its height; null makes pixels square.
        horizontal_aperture_offset: of the image's centre, to the right, in focal lengths.
        vertical_aperture_offset: downwards, in focal lengths.
        fovy: angle of view from the lowest to the highest row, rad, in place of the apertures; pixels are square.
        clipping_range: nearest and farthest distance along the axis that is seen, m.
        depth_clipping_behavior: what a distance is where nothing is seen: ``none`` inf, ``zero`` 0, ``max`` the
            farthest.
        max_num_envs: most environments that may be drawn: each takes milliseconds a picture.
        update_period: time between two measurements, s; 0 shows the present state at every reading.
    """

    def __init__(
        self,
        body_name: str,
        width: Count,
        height: Count,
        data_types: Annotated[Sequence[DataType], NotEmpty()] = ("rgb",),
        offset: CameraOffset | None = None,
        focal_length: Positive = 24.0,
        horizontal_aperture: Positive = 20.955,
        vertical_aperture: Positive | None = None,
        horizontal_aperture_offset: float = 0.0,
        vertical_aperture_offset: float = 0.0,
        fovy: Positive | None = None,
        clipping_range: PositiveInterval = (0.01, 20.0),
        depth_clipping_behavior: DepthClipping = "none",
        max_num_envs: Count = 16,
        update_period: NonNegative = 0.0,
    ) -> None:
        super().__init__(update_period)
        if fovy is not None:
            vertical_aperture = 2.0 * focal_length * math.tan(fovy / 2.0)
            horizontal_aperture = vertical_aperture * width / height
        elif vertical_aperture is None:
            vertical_aperture = horizontal_aperture * height / width
        self._focal_length = focal_length
        self._aperture = (horizontal_aperture, vertical_aperture)
        self._shift = (horizontal_aperture_offset, vertical_aperture_offset)
        self._pinhole = PinholePattern(width, height, focal_length, *self._aperture, *self._shift)
        self._body, self._offset, self._data_types = body_name, in_world_convention(offset), tuple(data_types)
        self._range = (float(clipping_range[0]), float(clipping_range[1]))
        self._clipping: DepthClipping = depth_clipping_behavior
        self._max_num_envs = max_num_envs

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        return self._pinhole.height, self._pinhole.width

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        """Find the body, and add the camera to it."""
        super().add_to(spec, name, robot)
        self._mount = Mount(self._body, robot, f"{self.key}.body_name")
        self.body_names = [self._mount.body]
        height, width = self.image_shape
        spec.body(self._mount.body).add_camera(
            name=self._name_in_model,
            pos=self._offset["pos"],
            quat=opengl_quat(self._offset),
            resolution=[width, height],
            sensor_size=self._aperture,
            focal_length=[self._focal_length] * 2,
            principal_length=[-self._focal_length * shift for shift in self._shift],  # to the left and up
        )

    @property
    def _name_in_model(self) -> str:
        return f"sensor/{self.name}"

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled.

        Raises:
            ConfigError: there are more environments than the camera may draw.
        """
        super().connect(sim, stream)
        if mistake := too_many(sim.num_envs, self._max_num_envs, self.key):
            raise mistake
        self._offset_pos, self._offset_quat = offset_pose(self._offset, sim.device)
        directions = self._pinhole.rays(sim.device)[1]
        self._cosines = directions[:, 0].view(1, *self.image_shape, 1)
        self._data = CameraData(sim.num_envs, self._pinhole, sim.device)
        self._numbers: dict[str, torch.Tensor] = {}
        for kind in self._data_types:
            if kind not in _LAYERS:
                labels, numbers = _labels(sim.model, kind)
                self._numbers[kind] = torch.tensor(numbers, dtype=torch.int32, device=sim.device)
                self._data.info[kind] = {"idToLabels": labels}
            floats = kind in DEPTHS
            dtype = torch.float32 if floats else torch.int32 if kind in self._numbers else torch.uint8
            self._data.add_output(kind, {"rgb": 3, "rgba": 4}.get(kind, 1), dtype)
        layers = tuple(dict.fromkeys(_LAYERS.get(kind, "geom") for kind in self._data_types))
        height, width = self.image_shape
        self._pictures = CameraPictures(sim.model, self._name_in_model, width, height, self._range, layers)

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Draw the pictures of some environments.

        Raises:
            NoGraphics: nothing can be drawn on this machine; the message names the sensor and what to install.
            SimulationFailure: the graphics driver gave up.
        """
        data, quat = self._data, self._mount.quat_w[ids]
        turn = self._mount.rot_w[ids]
        data.pos_w[ids] = self._mount.pos_w[ids] + rotation.rotate(turn, self._offset_pos.expand(len(turn), 3))
        data.quat_w_world[ids] = rotation.quat_mul(quat, self._offset_quat.expand_as(quat))
        if not len(turn):
            return
        try:
            drawn = self._pictures.draw(self._sim.view("qpos")[ids])
        except NoGraphics as error:
            error.key = self.key
            raise
        seen = {name: picture.to(self._sim.device) for name, picture in drawn.items()}
        for kind in self._data_types:
            data.output[kind][ids] = self._picture(kind, seen)

    def _picture(self, kind: str, seen: Mapping[str, torch.Tensor]) -> torch.Tensor:
        if kind == "rgb":
            return seen["colour"]
        if kind == "rgba":
            return torch.nn.functional.pad(seen["colour"], (0, 1), value=255)
        if kind in DEPTHS:
            depth = clipped(seen["depth"], self._range[1], self._clipping)
            return depth / self._cosines if kind == "distance_to_camera" else depth
        return self._numbers[kind][seen["geom"].long()]  # the last is nothing's, -1

    def state_dict(self) -> dict[str, Any]:
        """Return what is held until the next measurement."""
        return {**super().state_dict(), **(self._data.state_dict() if self.update_period > 0.0 else {})}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        if self.update_period > 0.0:
            self._data.load_state_dict(saved)


def _labels(model: mujoco.MjModel, kind: str) -> tuple[dict[int, str], list[int]]:
    """Return what each number of a segmentation stands for, and the number of each geom, of none the last."""
    if kind == "semantic_segmentation":
        numbers = [1 if is_ground(model.geom(g).name) else 2 for g in range(model.ngeom)]
        return {0: _BACKGROUND, 1: "ground", 2: "robot"}, [*numbers, 0]
    if kind == "instance_segmentation_fast":
        names = [model.body(b).name for b in range(model.nbody)]
        numbers = [1 + int(body) for body in model.geom_bodyid]
    else:
        names = [model.geom(g).name or f"geom_{g}" for g in range(model.ngeom)]
        numbers = list(range(1, model.ngeom + 1))
    return {0: _BACKGROUND, **dict(enumerate(names, start=1))}, [*numbers, 0]
