"""The engine ``physx``: NVIDIA PhysX moves the robots on the CPU, and MuJoCo computes what depends on their states.

PhysX simulates the robot's own USD file, not its MJCF, so that differences also show errors of the conversion. A batch
of MuJoCo simulations mirrors PhysX's states, computes link poses, velocities, rays, and pictures, and stores the model
fields that events change. Each physics step sends changes to PhysX, and reads the new states back.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError, SimulationFailure, nearest_name
from wheelleg_exp.paths import find_asset
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.options import RobotOptions, SimOptions
from wheelleg_exp.sim.physx.physx_stage import GROUND_PATH, ROBOTS, links_of, open_scene, write_scene
from wheelleg_exp.sim.terrain import grid_origins, is_ground

_XYZW, _WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]
_UNLIMITED = 1e10  # N·m
_FIELDS = mujoco.mjtConDataField
_NORMAL = sum(1 << int(f) for f in (_FIELDS.mjCONDATA_FOUND, _FIELDS.mjCONDATA_FORCE, _FIELDS.mjCONDATA_NORMAL))
_WIDTH = 7  # numbers of one contact: found (1), force (3), normal (3)
_SPACING = 0.5  # m; distance of the robots' starts in PhysX
# Relative difference, m, and rad, up to which the robots of PhysX and MuJoCo count as equal.
_SAME, _SAME_PLACE, _SAME_TURN = 1e-3, 1e-4, 0.01
_BODY_FIELDS = {"body_mass", "body_ipos", "body_iquat", "body_inertia"}
_SENT = _BODY_FIELDS | {"actuator_biasprm", "actuator_forcerange", "dof_armature", "dof_frictionloss", "dof_damping"}
_SENT |= {"geom_friction", "jnt_range", "jnt_limited", "opt.gravity"}


class PhysxEngine(BatchEngine):
    """N simulations on PhysX, in float32.

    Results are bit-reproducible, but not after a state was restored: PhysX gives no access to the contact data that its
    next step depends on. Raise ConfigError if PhysX cannot simulate the robot, ground, or sensors.
    """

    name = "physx"
    exact = False

    @classmethod
    def from_config(cls, model: mujoco.MjModel, num_envs: int, sim: SimOptions, robot: RobotOptions, /) -> Engine:
        usd = find_asset(robot.asset, key="env.robot.asset").resolve()
        return cls(model, num_envs, sim.nthread, usd, robot)

    def __init__(self, model: mujoco.MjModel, num_envs: int, nthread: int, usd: Path, robot: RobotOptions) -> None:
        self._sensordata = torch.zeros(num_envs, model.nsensordata, dtype=torch.float64)
        self._torque = torch.zeros(num_envs, model.nu, dtype=torch.float64)
        super().__init__(model, num_envs, nthread)
        root, links = links_of(usd)
        with tempfile.TemporaryDirectory(prefix="wheelleg_exp-") as folder:
            scene = Path(folder, "scene.usda")
            write_scene(scene, usd, root, links, model, num_envs, robot.self_collisions)
            self._physx, self._stage = open_scene(scene, self.nthread)
        from ovphysx.types import TensorType

        self._types, self._robots = TensorType, f"{ROBOTS}/env_*/{root}"
        self._bindings: dict[str, tuple[Any, torch.Tensor]] = {}
        self._sent: dict[str, torch.Tensor] = {}  # what PhysX was last sent about drives and shapes
        self._connect()
        # Largest distance, m, and angle, rad, of each link in PhysX from the same link in MuJoCo.
        self._gap, self._turn = torch.zeros(2, len(self._links), dtype=self.dtype)
        # Orientations of MuJoCo's link frames in the USD file's, (w, x, y, z). Only the root link's frame can differ.
        self._frames = torch.zeros(len(self._links), 4, dtype=self.dtype)
        self._frames[:, 0] = 1.0
        if robot.root_frame is not None:
            self._frames[0] = torch.nn.functional.normalize(torch.tensor(robot.root_frame, dtype=self.dtype), dim=0)
        self._contacts = self._contact_readers(links)
        self._fields_changed = True
        self._last_read = torch.full_like(self._motion, torch.nan)
        # On a plane, each robot starts near the origin of PhysX, where float32 positions are finest: at 60 m, they have
        # steps of 4 um, which make a policy's actions chatter. The robots may overlap there, but they never touch.
        ground = [geom for geom in range(model.ngeom) if is_ground(model.geom(geom).name)]
        flat = all(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE for geom in ground)
        self._can_shift = flat and bool((model.geom_quat[ground] == [1.0, 0.0, 0.0, 0.0]).all())
        self._shift = torch.zeros(num_envs, 3, dtype=self.dtype)
        self._start = grid_origins(num_envs, _SPACING, self.device)[:, :2].double()

    def _connect(self) -> None:
        model, (binding, _) = self.model, self._bound("DOF_POSITION")
        joints = [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
        bodies = [model.body(i).name for i in range(1, model.nbody)]
        for what, ours, theirs in (("joint", joints, binding.dof_names), ("body", bodies, binding.body_names)):
            if odd := sorted({*ours} ^ {*theirs}):
                message = f"PhysX and MuJoCo disagree about the {what} '{odd[0]}'"
                other = nearest_name(odd[0], [*ours, *theirs])
                raise ConfigError(message, key="env.robot.asset", expected="one robot in both", nearest=other)
        ids = [model.joint(name).id for name in binding.dof_names]
        self._places = torch.as_tensor(model.jnt_qposadr[ids].astype(int))
        self._dofs = torch.as_tensor(model.jnt_dofadr[ids].astype(int))
        self._joints = torch.tensor(ids)
        self._links = torch.tensor([model.body(name).id for name in binding.body_names])
        if binding.is_fixed_base or len(joints) == model.njnt:
            message = "the engine 'physx' only simulates robots with a floating base"
            raise ConfigError(message, key="env.robot.base", expected="floating, or env.sim.engine=mujoco")
        moves = {int(model.actuator_trnid[i, 0]): i for i in range(model.nu)}
        self._driven = torch.tensor([k for k, joint in enumerate(ids) if joint in moves], dtype=torch.long)
        self._actuators = torch.tensor([moves[joint] for joint in ids if joint in moves], dtype=torch.long)
        driven = [joint for joint in ids if joint in moves]
        self._unlimited = torch.as_tensor(model.jnt_limited[driven] == 0)
        self._of_usd = tuple(self._read(f"BODY_{name}") for name in ("MASS", "INERTIA", "COM_POSE"))
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        shapes = [g for body in self._links.tolist() for g in np.flatnonzero(solid & (model.geom_bodyid == body))]
        self._shapes = torch.tensor(shapes, dtype=torch.long)
        found = self._bound("SHAPE_FRICTION_AND_RESTITUTION")[1].shape[1]
        if found != len(shapes):
            message = f"PhysX has {found} collision shapes of the robot, and MuJoCo has {len(shapes)}"
            raise ConfigError(message, key="env.robot.asset", expected="the same shapes in both")

    def __del__(self) -> None:
        # At the end of the process, ovphysx may already have released everything.
        with suppress(AttributeError, RuntimeError):
            self._physx.wait_task(self._physx.detach_ovstage())
            self._stage.destroy()
            self._physx.destroy()

    def promise(self) -> dict[str, object]:
        because = "PhysX gives no access to the contact data on which the step after a restored state depends"
        return {**super().promise(), "version": metadata.version("ovphysx"), "because": because}

    def view(self, name: str) -> torch.Tensor:
        own = {"sensordata": self._sensordata, "actuator_force": self._torque}
        return own[name] if name in own else super().view(name)

    def may_differ(self, name: str) -> bool:
        return name in _SENT

    def expand(self, name: str) -> torch.Tensor:
        if name not in _SENT:
            message = f"the engine 'physx' cannot change the model field '{name}'"
            raise ConfigError(message, key="env.sim.engine", expected="mujoco")
        self._fields_changed = True
        return super().expand(name)

    def set_const(self) -> None:
        self._fields_changed = True
        super().set_const()

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self._fields_changed = True
        self._last_read.fill_(torch.nan)

    def step(self) -> None:
        if self._fields_changed:
            self._send_fields()
        self._send_states()
        self._send_controls()
        self._send_wrenches()
        try:
            self._physx.step_sync(float(self.model.opt.timestep))
        except RuntimeError as error:
            raise SimulationFailure(f"PhysX failed: {error}") from error
        self._read_states()
        self.forward()
        self._read_contacts()
        self._compare_links()

    def _compare_links(self) -> None:
        pose, links = self._read("LINK_POSE"), self._links
        apart = pose[..., :3] + self._shift[:, None] - self.derived("xpos")[:, links]
        frames = self._frames.expand(self.num_envs, -1, -1).flatten(0, 1)
        turned = rotation.quat_mul(pose[..., 3:][..., _WXYZ].flatten(0, 1), frames).view_as(pose[..., 3:])
        same = (turned * self.derived("xquat")[:, links]).sum(dim=2).abs().clamp(max=1.0)
        for worst, now in ((self._gap, torch.linalg.vector_norm(apart, dim=2)), (self._turn, 2.0 * same.acos())):
            worst.copy_(torch.fmax(worst, now.nan_to_num(0.0).amax(dim=0)))  # NaN: PhysX's simulation has failed

    def robot_differences(self) -> list[str]:
        joints = [self.model.joint(int(i)).name for i in self._joints]
        links = [self.model.body(int(i)).name for i in self._links]
        shapes = [self.model.body(int(self.model.geom_bodyid[i])).name for i in self._shapes]
        moments = torch.linalg.eigvalsh(self._read("BODY_INERTIA").unflatten(2, (3, 3)))
        ours = {name: self._field(name)[:, self._links] for name in ("body_mass", "body_inertia", "body_ipos")}
        pairs = [
            ("mass", links, ours["body_mass"], self._read("BODY_MASS")),
            ("inertia", links, ours["body_inertia"].sort(dim=2).values, moments),
        ]
        for name, sent in self._sent.items():
            what, names = name.partition("_")[2].lower().replace("_", " "), joints if name.startswith("DOF") else shapes
            pairs.append((what, names, sent, self._read(name)))
        found = [text for pair in pairs if (text := _difference(*pair))]
        centres = (rotation.quat_to_matrix(self._frames) @ ours["body_ipos"].unsqueeze(3)).squeeze(3)
        moved = torch.linalg.vector_norm(centres - self._read("BODY_COM_POSE")[..., :3], dim=2).amax(dim=0)
        far = [
            ("centre of mass", moved, _SAME_PLACE, 1e3, " mm away"),
            ("position", self._gap, _SAME_PLACE, 1e3, " mm away"),
            ("orientation", self._turn, _SAME_TURN, 180.0 / math.pi, "° away"),
        ]
        for what, sizes, limit, factor, unit in far:
            if (largest := float(sizes.max())) > limit:
                found.append(f"{what} of {links[int(sizes.argmax())]} ({factor * largest:.2g}{unit})")
        return found

    def _bound(self, name: str) -> tuple[Any, torch.Tensor]:
        """Return PhysX's access to a quantity of the robots, and a tensor of its shape, float32."""
        if name not in self._bindings:
            binding = self._physx.create_tensor_binding(self._robots, tensor_type=self._types[f"ARTICULATION_{name}"])
            self._bindings[name] = binding, torch.zeros(binding.shape, dtype=torch.float32)
        return self._bindings[name]

    def _write(self, name: str, values: torch.Tensor, rows: torch.Tensor | None = None) -> None:
        binding, buffer = self._bound(name)
        buffer.copy_(values)
        binding.write(buffer, indices=None if rows is None else rows.int())

    def _read(self, name: str) -> torch.Tensor:
        binding, buffer = self._bound(name)
        binding.read(buffer)
        return buffer.double()

    def _field(self, name: str) -> torch.Tensor:
        if name in self.expanded:
            return self.expanded[name].double()
        values = self.constant(name).double()
        return values.expand(self.num_envs, *values.shape)

    def _send_fields(self) -> None:
        dofs, shape = self._dofs, self._bound("DOF_POSITION")[1].shape
        bias = self._field("actuator_biasprm")[:, self._actuators]
        limited = self.constant("actuator_forcelimited")[self._actuators].bool()
        limit = torch.where(limited, self._field("actuator_forcerange")[:, self._actuators, 1], _UNLIMITED)
        by_speed = self._unlimited & (bias[..., 2] < 0.0)
        stiffness = torch.where(by_speed, 0.0, -bias[..., 1])
        drives = {"STIFFNESS": stiffness, "DAMPING": -bias[..., 2], "MAX_FORCE": limit}
        blank = torch.zeros(shape, dtype=self.dtype)
        self._sent = {f"DOF_{name}": blank.index_copy(1, self._driven, values) for name, values in drives.items()}
        self._sent["DOF_ARMATURE"] = self._field("dof_armature")[:, dofs].clone()
        friction, viscous = self._field("dof_frictionloss")[:, dofs], self._field("dof_damping")[:, dofs]
        self._sent["DOF_FRICTION_PROPERTIES"] = torch.stack((friction, friction, viscous), dim=2)
        sliding = self._field("geom_friction")[:, self._shapes, 0]
        self._sent["SHAPE_FRICTION_AND_RESTITUTION"] = torch.stack((sliding, sliding, 0.0 * sliding), dim=2)
        for name, values in self._sent.items():
            self._write(name, values)
        if "jnt_range" in self.expanded:
            self._write("DOF_LIMIT", self._field("jnt_range")[:, self._joints])
        if _BODY_FIELDS & self.expanded.keys():
            self._send_bodies()
        self._fields_changed = False

    def _send_bodies(self) -> None:
        """Change the masses of the USD file as events have changed those of the model."""
        mass, inertia, centre = self._of_usd
        now = {name: self._field(name)[:, self._links] for name in _BODY_FIELDS}
        made = {name: self.constant(name)[self._links] for name in _BODY_FIELDS}
        self._write("BODY_MASS", mass * now["body_mass"] / made["body_mass"])
        ratio = now["body_inertia"] / made["body_inertia"]
        is_even = (ratio - ratio[..., :1]).abs().amax(dim=2, keepdim=True) < 1e-9
        is_even &= (now["body_iquat"] == made["body_iquat"]).all(dim=2, keepdim=True)
        # If the principal moments change by different factors, MuJoCo's moments and axes replace those of the file.
        own = torch.diag_embed(now["body_inertia"]).flatten(2)
        self._write("BODY_INERTIA", torch.where(is_even, inertia * ratio[..., :1], own))
        frames = self._frames.expand(self.num_envs, -1, -1).flatten(0, 1)
        turned = rotation.quat_mul(frames, now["body_iquat"].flatten(0, 1)).view(self.num_envs, -1, 4)
        axes = torch.where(is_even, centre[..., 3:], turned[..., _XYZW])
        shift = (now["body_ipos"] - made["body_ipos"]).unsqueeze(3)
        moved = centre[..., :3] + (rotation.quat_to_matrix(self._frames) @ shift).squeeze(3)
        self._write("BODY_COM_POSE", torch.cat((moved, axes), dim=2))

    def _send_states(self) -> None:
        # Only write the states that were changed since the last step, because PhysX's own states are more exact.
        rows = (self._motion != self._last_read).any(dim=1).nonzero().flatten()
        if not len(rows):
            return
        qpos, qvel = self.view("qpos"), self.view("qvel")
        if self._can_shift:
            moved = (qpos[:, :2] != self._last_read[:, :2]).any(dim=1, keepdim=True)
            self._shift[:, :2] = torch.where(moved, qpos[:, :2] - self._start, self._shift[:, :2])
        back = self._frames[0] * torch.tensor([1.0, -1.0, -1.0, -1.0])
        quat = rotation.quat_mul(qpos[:, 3:7], back.expand(self.num_envs, 4))
        self._write("ROOT_POSE", torch.cat((qpos[:, :3] - self._shift, quat[:, _XYZW]), dim=1), rows)
        matrix = rotation.quat_to_matrix(qpos[:, 3:7])
        spin = rotation.rotate(matrix, qvel[:, 3:6])
        self._write("ROOT_VELOCITY", torch.cat((qvel[:, :3] + self._lever(matrix, spin), spin), dim=1), rows)
        self._write("DOF_POSITION", _wrapped(qpos[:, self._places]), rows)
        self._write("DOF_VELOCITY", qvel[:, self._dofs], rows)

    def _lever(self, matrix: torch.Tensor, spin: torch.Tensor) -> torch.Tensor:
        """Return the velocity of the root's centre of mass minus that of the root link's origin, m/s, (N, 3)."""
        centre = self._field("body_ipos")[:, int(self._links[0])]
        return torch.cross(spin, rotation.rotate(matrix, centre), dim=-1)

    def _send_controls(self) -> None:
        control, bias = self.view("ctrl"), self._field("actuator_biasprm")
        torque = control.clone()
        places, dofs = self._places[self._driven], self._dofs[self._driven]
        kp, kd = -bias[:, self._actuators, 1], -bias[:, self._actuators, 2]
        asked = control[:, self._actuators]
        shape = self._bound("DOF_POSITION")[1].shape
        # A drive's torque is kp (q* - q) + kd (v* - v), and a control is kp q* + kd v* + effort. PhysX has no targets
        # beyond one turn, so the velocity target of a joint without limits contains the position error.
        by_speed = self._unlimited & (kd > 0.0)
        of_position, of_velocity = (kp > 0.0) & ~by_speed, by_speed | ((kp == 0.0) & (kd > 0.0))
        pulled = torch.where(by_speed, asked - kp * self.view("qpos")[:, places], asked)
        targets = {
            "DOF_POSITION_TARGET": torch.where(of_position, asked / kp, 0.0),
            "DOF_VELOCITY_TARGET": torch.where(of_velocity, pulled / kd, 0.0),
            "DOF_ACTUATION_FORCE": torch.where(of_position | of_velocity, 0.0, asked),
        }
        for name, values in targets.items():
            self._write(name, torch.zeros(shape, dtype=self.dtype).index_copy_(1, self._driven, values))
        torque[:, self._actuators] -= kp * self.view("qpos")[:, places] + kd * self.view("qvel")[:, dofs]
        low, high = self._field("actuator_forcerange").unbind(dim=2)
        limited = self.constant("actuator_forcelimited").bool()
        self._torque.copy_(torch.where(limited, torque.clamp(low, high), torque))

    def _send_wrenches(self) -> None:
        wrench = self.view("xfrc_applied")[:, self._links].clone()
        if "opt.gravity" in self.expanded:  # The scene has one gravity; a force on each body gives the difference.
            excess = self.expanded["opt.gravity"] - torch.as_tensor(self.model.opt.gravity)
            wrench[..., :3] += self._field("body_mass")[:, self._links, None] * excess[:, None]
        if wrench.any():
            centres = self.derived("xipos")[:, self._links] - self._shift[:, None]
            self._write("LINK_WRENCH", torch.cat((wrench, centres), dim=2))

    def _read_states(self) -> None:
        qpos, qvel = self.view("qpos"), self.view("qvel")
        pose, velocity = self._read("ROOT_POSE"), self._read("ROOT_VELOCITY")
        quat = rotation.quat_mul(pose[:, 3:][:, _WXYZ], self._frames[0].expand(self.num_envs, 4))
        quat /= torch.linalg.vector_norm(quat, dim=1, keepdim=True)
        matrix = rotation.quat_to_matrix(quat)
        qpos[:, :7] = torch.cat((pose[:, :3] + self._shift, quat), dim=1)
        linear = velocity[:, :3] - self._lever(matrix, velocity[:, 3:])
        qvel[:, :6] = torch.cat((linear, rotation.rotate_inverse(matrix, velocity[:, 3:])), dim=1)
        before = qpos[:, self._places]
        qpos[:, self._places] = before + _wrapped(self._read("DOF_POSITION") - before)
        qvel[:, self._dofs] = self._read("DOF_VELOCITY")
        self._last_read.copy_(self._motion)

    def _contact_readers(self, links: dict[str, str]) -> list[tuple[Any, int, bool]]:
        model, readers = self.model, []
        for sensor in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).tolist():
            on_ground = bool(model.sensor_reftype[sensor] == mujoco.mjtObj.mjOBJ_BODY)
            if model.sensor_intprm[sensor, 0] != _NORMAL or (on_ground and model.sensor_refid[sensor] != 0):
                what = "contact points, friction, or forces between links, which the engine 'physx' does not measure"
                message = f"the contact sensor '{model.sensor(sensor).name}' reads {what}"
                raise ConfigError(message, key="env.scene.sensors", expected="normal forces, or env.sim.engine=mujoco")
            prims = f"{ROBOTS}/env_*/{links[model.body(int(model.sensor_objid[sensor])).name]}"
            ground = [f"{GROUND_PATH}/geom_*"] if on_ground else None
            reader = self._physx.create_contact_binding([prims], ground, int(on_ground))
            readers.append((reader, int(model.sensor_adr[sensor]), on_ground))
        return readers

    def _read_contacts(self) -> None:
        for reader, start, on_ground in self._contacts:
            forces = np.zeros((self.num_envs, *([1] if on_ground else []), 3), dtype=np.float32)
            (reader.read_normal_force_matrix if on_ground else reader.read_net_normal_forces)(forces)
            force = torch.from_numpy(forces).double().view(self.num_envs, 3)
            size = torch.linalg.vector_norm(force, dim=1, keepdim=True)
            # As in MuJoCo, the normal points away from the sensed body. One contact stands for all contacts.
            normal = torch.where(size > 0.0, -force / size, 0.0)
            row = torch.cat(((size > 0.0).double(), size, torch.zeros(self.num_envs, 2), normal), dim=1)
            self._sensordata[:, start : start + _WIDTH] = row


def _difference(what: str, names: list[str], ours: torch.Tensor, theirs: torch.Tensor) -> str:
    """Return a text that names the parts with different values (N, K, ...), such as ``inertia of l_leg (2 times)``."""
    wrong = (theirs - ours).abs() > _SAME * ours.abs() + 1e-9
    odd = wrong.transpose(0, 1).flatten(1).any(dim=1).nonzero().flatten().tolist()
    if not odd:
        return ""
    mine = wrong[:, odd[0]]
    first, second = float(ours[:, odd[0]][mine][0]), float(theirs[:, odd[0]][mine][0])
    size = f"{second / first:.3g} times" if first else f"{second:.3g}, not 0"
    return f"{what} of {names[odd[0]]}{f' and {len(odd) - 1} more' if len(odd) > 1 else ''} ({size})"


def _wrapped(angles: torch.Tensor) -> torch.Tensor:
    """Return angles between -2 pi and 2 pi, rad: PhysX counts no further turns of a joint."""
    return torch.remainder(angles + 2.0 * math.pi, 4.0 * math.pi) - 2.0 * math.pi
