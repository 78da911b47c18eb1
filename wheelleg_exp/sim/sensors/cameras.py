"""Cameras: one that MuJoCo's renderer draws, and a depth camera that casts rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import mujoco
import torch

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Broken, Count, NonNegative, NotEmpty, Positive, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rendering.camera_job import CameraOrder, Layer
from wheelleg_exp.rendering.live_pictures import CameraPictures
from wheelleg_exp.rendering.renderer import NoGraphics, too_many
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.sensors.ray_caster import RayCaster
from wheelleg_exp.sim.sensors.ray_patterns import PinholePattern
from wheelleg_exp.sim.sensors.sensor_base import LazySensor, Mount, Offset, offset_fits, offset_pose
from wheelleg_exp.sim.terrain import is_ground
from wheelleg_exp.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot


Convention = Literal["world", "ros", "opengl"]
CameraOffset = Mapping[Literal["pos", "rot", "convention"], Sequence[float] | Convention]
DepthClipping = Literal["max", "zero", "none"]
DEPTHS = ("depth", "distance_to_image_plane", "distance_to_camera")
# ``_FROM_WORLD`` maps each camera convention of Isaac Lab to the rotation (w, x, y, z) from the convention ``world``.
_FROM_WORLD: dict[str, tuple[float, float, float, float]] = {
    "world": (1.0, 0.0, 0.0, 0.0),
    "ros": (0.5, -0.5, 0.5, -0.5),
    "opengl": (0.5, 0.5, -0.5, -0.5),
}


class CameraData(Stateful):
    """Measurements of a camera.

    Attributes:
        pos_w: position of the camera, m, (N, 3).
        quat_w_world: orientation of the camera, axes x forward, y left, z up, (w, x, y, z), (N, 4).
        intrinsic_matrices: px, (N, 3, 3): a point (x right, y down, z forward) appears at (fx x/z + cx, fy y/z + cy);
            the first pixel extends from 0 to 1.
        output: images by data type, (N, height, width, channels).
        info: labels of a segmentation's ids, ``info[data_type]["idToLabels"]``.
    """

    def __init__(self, num_envs: int, pinhole: PinholePattern, device: torch.device) -> None:
        self.pos_w = self.buffer("pos_w", torch.zeros(num_envs, 3, device=device))
        self.quat_w_world = self.buffer("quat_w_world", torch.zeros(num_envs, 4, device=device))
        self.image_shape = (pinhole.height, pinhole.width)
        self.intrinsic_matrices = torch.tensor(pinhole.intrinsics, device=device).repeat(num_envs, 1, 1)
        self.output: dict[str, torch.Tensor] = self.buffer("output", {})
        self.info: dict[str, dict[str, dict[int, str]]] = {}

    @property
    def quat_w_ros(self) -> torch.Tensor:
        """Orientation of the camera, (w, x, y, z), (N, 4), with its x axis to the right, y axis down, z axis ahead."""
        return convert_convention(self.quat_w_world, "world", "ros")

    @property
    def quat_w_opengl(self) -> torch.Tensor:
        """Orientation of the camera, (w, x, y, z), (N, 4), with its x axis to the right, y axis up, z axis backward."""
        return convert_convention(self.quat_w_world, "world", "opengl")

    def add_output(self, data_type: str, channels: int, dtype: torch.dtype) -> None:
        """Allocate the memory for a camera's images of one data type."""
        size = (len(self.pos_w), *self.image_shape, channels)
        self.output[data_type] = torch.zeros(size, dtype=dtype, device=self.pos_w.device)


def _camera_offset_fits(offset: CameraOffset | None) -> Iterator[Broken]:
    yield from offset_fits(offset)
    convention = (offset or {}).get("convention", "ros")
    if convention not in _FROM_WORLD:
        yield Broken("offset.convention", f"{convention!r} is not a convention", "one of " + ", ".join(_FROM_WORLD))


def in_world_convention(offset: CameraOffset | None) -> Offset:
    """Convert a camera's offset to the convention ``world`` (x forward, y left, z up); the default is ``ros``."""
    given: Mapping[Any, Any] = offset or {}
    rot = torch.tensor([given.get("rot", (1.0, 0.0, 0.0, 0.0))], dtype=torch.float32, device="cpu")
    turned = convert_convention(rot, given.get("convention", "ros"), "world")[0].tolist()
    return {"pos": list(given.get("pos", (0.0, 0.0, 0.0))), "rot": turned}


def clipped(depth: torch.Tensor, farthest: float, behavior: DepthClipping) -> torch.Tensor:
    """Replace distances greater than ``farthest``, m, by inf, 0, or ``farthest``, as in Isaac Lab."""
    instead = {"none": math.inf, "zero": 0.0, "max": farthest}[behavior]
    return depth.masked_fill(depth > farthest, instead)


def convert_convention(quat: torch.Tensor, origin: Convention, target: Convention) -> torch.Tensor:
    """Convert orientations (n, 4), (w, x, y, z), from one camera convention to a second one."""
    w, x, y, z = _FROM_WORLD[origin]
    both = torch.tensor([(w, -x, -y, -z), _FROM_WORLD[target]], dtype=quat.dtype, device=quat.device)
    back, there = (axes.expand_as(quat) for axes in both)
    return rotation.quat_mul(rotation.quat_mul(quat, back), there)


_Segmentation = Literal["semantic_segmentation", "instance_segmentation_fast", "instance_id_segmentation_fast"]
DataType = Literal["rgb", "rgba", "depth", "distance_to_image_plane", "distance_to_camera", _Segmentation]
_LAYERS: dict[str, Layer] = {"rgb": "colour", "rgba": "colour", **dict.fromkeys(DEPTHS, "depth")}
_BACKGROUND = "BACKGROUND"


def _range_of_angles(fovy: float | None, clipping_range: Sequence[float]) -> Iterator[Broken]:
    if fovy is not None and fovy >= math.pi:
        yield Broken("fovy", f"{fovy!r} is pi or more", "an angle in radians below pi")
    if clipping_range[0] == clipping_range[1]:
        yield Broken("clipping_range", "has no depth", "[nearest, farthest] in m")


@relation(_range_of_angles)
@relation(_camera_offset_fits)
class Camera(LazySensor):
    """A camera on a robot's body, for few environments, because MuJoCo renders each environment separately.

    The first read of an image needs a graphics driver that renders without a display (EGL or OSMesa). Images show only
    the environment's own robot and the ground, in the colours and lights of the compiled model. With one driver, equal
    states give equal images.

    Args:
        body_name: expression of the body.
        width: px.
        height: px.
        data_types: kinds of images. ``rgb`` and ``rgba`` are uint8 colours. ``distance_to_image_plane`` or ``depth`` is
            the distance along the camera's axis, m, and ``distance_to_camera`` the distance along the pixel's ray, m.
            ``semantic_segmentation`` contains int32 ids of ground and robot, ``instance_segmentation_fast`` ids of
            bodies, and ``instance_id_segmentation_fast`` ids of geoms.
        offset: pose in the body's frame: ``pos``, m, and ``rot``, (w, x, y, z), of axes with a ``convention``. A camera
            looks along x, with z up, in the convention ``world``; along z, with -y up, in ``ros``; and along -z, with y
            up, in ``opengl``.
        focal_length: in the unit of the apertures; only their ratio matters.
        horizontal_aperture: width of the image plane.
        vertical_aperture: height of the image plane; null makes pixels square.
        horizontal_aperture_offset: offset of the image's centre to the right, in focal lengths.
        vertical_aperture_offset: offset of the image's centre downwards, in focal lengths.
        fovy: vertical angle of view, rad, instead of the apertures; pixels are square.
        clipping_range: nearest and farthest visible distance along the axis, m.
        depth_clipping_behavior: a pixel that sees nothing gets the distance inf with the value ``none``, 0 with
            ``zero``, and the largest measurable distance with ``max``.
        max_num_envs: maximum number of environments, because each image takes milliseconds.
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
        clipping_range: constraints.PositiveInterval = (0.01, 20.0),
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
        self.image_shape = (height, width)
        self._body, self._offset, self._data_types = body_name, in_world_convention(offset), tuple(data_types)
        self._range = (float(clipping_range[0]), float(clipping_range[1]))
        self._clipping: DepthClipping = depth_clipping_behavior
        self._max_num_envs = max_num_envs

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        super().add_to(spec, name, robot)
        self._mount = Mount(self._body, robot, f"{self.key}.body_name")
        self.body_names = [self._mount.body]
        quat = convert_convention(torch.tensor([self._offset["rot"]], device="cpu"), "world", "opengl")[0].tolist()
        body = spec.body(self._mount.body)
        camera = body.add_camera(name=f"sensor/{name}", pos=self._offset["pos"], quat=quat)
        camera.resolution, camera.sensor_size = self.image_shape[::-1], self._aperture
        # A positive ``principal_length`` of a MuJoCo camera shifts the image's centre to the left and up.
        camera.focal_length = [self._focal_length] * 2
        camera.principal_length = [-self._focal_length * shift for shift in self._shift]

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        if mistake := too_many(sim.num_envs, self._max_num_envs, self.key):
            raise mistake
        self._offset_pos, self._offset_quat = offset_pose(self._offset, sim.device)
        self._cosines = self._pinhole.rays(sim.device)[1][:, 0].view(1, *self.image_shape, 1)
        data = CameraData(sim.num_envs, self._pinhole, sim.device)
        self._data = self.child("_data", data, saved=self.update_period > 0.0)
        self._numbers: dict[str, torch.Tensor] = {}
        for kind in self._data_types:
            if kind not in _LAYERS:
                labels, numbers = _labels(sim.model, kind)
                self._numbers[kind] = torch.tensor(numbers, dtype=torch.int32, device=sim.device)
                self._data.info[kind] = {"idToLabels": labels}
            dtype = torch.float32 if kind in DEPTHS else torch.int32 if kind in self._numbers else torch.uint8
            self._data.add_output(kind, {"rgb": 3, "rgba": 4}.get(kind, 1), dtype)
        layers = tuple(dict.fromkeys(_LAYERS.get(kind, "geom") for kind in self._data_types))
        height, width = self.image_shape
        order = CameraOrder(sim.model, f"sensor/{self.name}", width, height, self._range, layers)
        self._pictures = CameraPictures(order)

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Render the images of the environments ``ids``; raise NoGraphics or SimulationFailure if rendering fails."""
        data, quat, turn = self._data, self._mount.quat_w[ids], self._mount.rot_w[ids]
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
        # A background pixel has the geom index -1, which selects the last segmentation id, that of the background.
        return self._numbers[kind][seen["geom"].long()]


def _labels(model: mujoco.MjModel, kind: str) -> tuple[dict[int, str], list[int]]:
    """Return the label of each segmentation id, and the segmentation ids of all geoms and of the background."""
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


RayDepth = Literal["distance_to_image_plane", "distance_to_camera", "depth"]


@relation(_camera_offset_fits)
class RayCasterCamera(RayCaster):
    """A depth camera on a body of the robot, for any number of environments; the camera's rays hit only the ground.

    No graphics driver is needed. A pixel's distance is that along the ray through its centre.

    Args:
        pattern: the pixels, a ``PinholePattern``.
        data_types: types of the images, ``distance_to_image_plane`` or ``depth`` (m, along the camera's axis) and
            ``distance_to_camera`` (m, along the pixel's ray).
        offset: pose in the body's frame, as in ``Camera``: ``pos``, m, ``rot``, (w, x, y, z), and ``convention``.
        depth_clipping_behavior: a pixel that sees nothing gets the distance inf with the value ``none``, 0 with
            ``zero``, and the largest measurable distance with ``max``.
    """

    _data: CameraData

    def __init__(
        self,
        body_name: str,
        pattern: Annotated[PinholePattern, constraints.Targeted()],
        data_types: Annotated[Sequence[RayDepth], NotEmpty()] = ("distance_to_image_plane",),
        offset: CameraOffset | None = None,
        max_distance: Positive = 1e6,
        depth_clipping_behavior: DepthClipping = "none",
        update_period: NonNegative = 0.0,
    ) -> None:
        if not isinstance(pattern, PinholePattern):
            raise ConfigError("has no pixels", key="pattern", expected="a _target_ of PinholePattern")
        pose = in_world_convention(offset)
        super().__init__(body_name, pattern, pose, "base", max_distance, update_period=update_period)
        self._pinhole, self._data_types = pattern, tuple(data_types)
        self.image_shape = (pattern.height, pattern.width)
        self._clipping: DepthClipping = depth_clipping_behavior

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        self._offset_pos, self._offset_quat = offset_pose(self._offset, sim.device)
        self._cosines = self._pinhole.rays(sim.device)[1][:, 0]
        data = CameraData(sim.num_envs, self._pinhole, sim.device)
        self._data = self.child("_data", data, saved=self.update_period > 0.0)
        for kind in self._data_types:
            self._data.add_output(kind, 1, torch.float32)

    def sense(self, ids: torch.Tensor | slice) -> None:
        data, pos, quat = self._data, self._mount.pos_w[ids], self._mount.quat_w[ids]
        data.pos_w[ids] = pos + rotation.rotate(self._mount.rot_w[ids], self._offset_pos.expand(len(pos), 3))
        data.quat_w_world[ids] = rotation.quat_mul(quat, self._offset_quat.expand_as(quat))
        _, _, far = self._cast(ids, pos, self.drift[ids])
        far = far.masked_fill(far < 0.0, math.inf)
        for kind in self._data_types:
            depth = far if kind == "distance_to_camera" else far * self._cosines
            depth = clipped(depth, self._max_distance, self._clipping)
            data.output[kind][ids] = depth.view(-1, *self.image_shape, 1)
