"""The engine ``warp``: simulations on an NVIDIA GPU with mujoco-warp, in float32."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.options import RobotOptions, SimOptions
from wheelleg_exp.sim.warp_runtime import ENGINE, Graphs, load, put_model, repeat_torch

# By default, the contact buffer has room for 24 contacts per simulation; a robot that lies on the ground has about 12.
_CONTACTS = 24
# A geom has several contact points on a height field or mesh, and a wheel at the edge of a step touches several boxes.
_ON_RELIEF = 48
_GRAIN = 16
_ROWS_OF_EQUALITY = 6


@dataclass(frozen=True)
class Capacity:
    """Capacity of mujoco-warp's buffers: the largest numbers of ``contacts`` and constraint ``rows`` per simulation."""

    contacts: int
    rows: int


def capacity_for(model: mujoco.MjModel, nconmax: int, njmax: int) -> Capacity:
    """Return the contact and constraint capacities for a model; 0 for ``nconmax`` or ``njmax`` means an estimate."""
    uneven = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_MESH))
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    relief = bool((np.isin(model.geom_type, uneven) & solid).any() or (solid & (model.geom_bodyid == 0)).sum() > 1)
    contacts = nconmax or (_ON_RELIEF if relief else _CONTACTS)
    if njmax:
        return Capacity(contacts, njmax)
    # Each contact needs 2 (condim - 1) constraint rows with a pyramidal friction cone, and fewer with an elliptic cone.
    rows_of_contact = 2 * (int(model.geom_condim.max(initial=3)) - 1)
    rows = contacts * rows_of_contact + model.neq * _ROWS_OF_EQUALITY
    rows += int((model.jnt_limited != 0).sum()) + int((model.dof_frictionloss != 0).sum())
    rows += int((model.tendon_limited != 0).sum()) + int((model.tendon_frictionloss != 0).sum())
    return Capacity(contacts, -(-rows // _GRAIN) * _GRAIN)


class Overflow:
    """Detects that contacts or constraint rows exceeded the engine's capacity, without waiting for a GPU.

    ``flags`` (N,) int are mujoco-warp's overflow flags: a live view that is never cleared. With ``is_ordered``, a
    contact sensor that drops contacts is an error too, because it drops them in no fixed order.
    """

    def __init__(self, kinds: Any, flags: torch.Tensor, room: Capacity, is_ordered: bool) -> None:
        self._flags, self._room = flags, room
        self._rows = int(kinds.NEFC | kinds.NJMAX_NNZ)
        self._contacts = int(kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD)
        self._watched = self._rows | self._contacts | (int(kinds.CONTACT_MATCH) if is_ordered else 0)
        self._seen = torch.zeros((), dtype=flags.dtype, device="cpu", pin_memory=flags.is_cuda)

    def look(self) -> None:
        """Start to copy the overflow flags to the host, without waiting; ``require_none`` reads the copy."""
        self._seen.copy_((self._flags & self._watched).amax(), non_blocking=True)

    def require_none(self, data: Any) -> None:
        """Raise SimulationFailure if the overflow flags on the host report too many contacts or constraint rows."""
        flags = int(self._seen)
        if not flags:
            return
        if not flags & (self._rows | self._contacts):
            message = "a contact sensor found too many contacts, and dropped some in no fixed order"
            raise SimulationFailure(message, key="env.sim.deterministic", expected="false")
        if flags & self._rows:
            key, has, needed = "env.sim.njmax", self._room.rows, int(data.nefc.numpy().max())
            what = "constraint rows in one simulation"
        else:
            found = max(int(data.nacon.numpy()[0]), int(data.ncollision.numpy()[0]))
            key, has, needed = "env.sim.nconmax", self._room.contacts, -(-found // int(data.nworld))
            what = "contacts per simulation on average"
        message = f"there are more than {has} {what}, and the excess ones were dropped"
        raise SimulationFailure(message, key=key, expected=f"{max(needed, 2 * has)} or more")


# ``STATE`` lists MuJoCo's data fields that, together with the model, determine a simulation's next physics step.
STATE = (
    *("time", "qpos", "qvel", "act", "history", "plastic", "qacc_warmstart"),
    *("ctrl", "qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata"),
)
# ``DERIVED`` lists the data fields that the functions kinematics, com_pos and com_vel of mujoco-warp compute.
DERIVED = frozenset(
    """xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat subtree_com cdof cinert cvel
    cdof_dot sensordata""".split()  # noqa: SIM905
)
# ``CONSTANTS`` lists the model fields that MuJoCo's function set_const computes.
CONSTANTS = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0", "tendon_length0", "tendon_invweight0"),
    *("eq_data", "cam_pos0", "cam_poscom0", "cam_mat0", "light_pos0", "light_poscom0", "light_dir0"),
    *("geom_aabb", "geom_rbound"),
)
_HUGE = 1e10  # A position or velocity above MuJoCo's limit mjMAXVAL counts as invalid.
_LEAST_MATCHES = 8
_MOTION = ("qpos", "qvel")
_UNORDERED = ("cuda",)  # On these types of devices, threads run in no fixed order.


class WarpEngine(Engine):
    """N simulations on mujoco-warp.

    It agrees with MuJoCo to single precision. Runs are bit-reproducible on the CPU. On a GPU, the order of contacts and
    sums varies, unless ``SimOptions.deterministic`` is set. Raise ConfigError if a package or device is missing, or the
    model is not supported.
    """

    name = "warp"

    @classmethod
    def from_config(cls, model: mujoco.MjModel, num_envs: int, sim: SimOptions, robot: RobotOptions, /) -> Engine:
        del robot
        return cls(model, num_envs, sim)

    def __init__(self, model: mujoco.MjModel, num_envs: int, options: SimOptions) -> None:
        self.model = model
        self.num_envs = num_envs
        self.device = torch.device(options.device)
        if self.device.type == "cuda":
            self.device = torch.device("cuda", self.device.index or 0)
        self.dtype = torch.float32
        self.nthread = 1
        self.exact = self.device.type == "cpu" or options.deterministic
        self.expanded = {}
        self.asked = set()
        wp, mjw = load(self.device)
        self._wp, self._mjw = wp, mjw
        self._captures = options.graph_step and self.device.type == "cuda"
        self._graphs = Graphs(wp, self.device, options.graph)
        self.room = capacity_for(model, options.nconmax, options.njmax)
        with self._graphs.here():
            self._m = put_model(mjw, model)
            self._d = mjw.make_data(model, nworld=num_envs, nconmax=self.room.contacts, njmax=self.room.rows)
        self._m.opt.warn_overflow = 0  # A contact buffer overflow raises an error instead of a warning.
        # Each contact sensor searches at least twice as many contacts as it reports.
        of_contacts = model.sensor_type == int(mujoco.mjtSensor.mjSENS_CONTACT)
        slots = int(model.sensor_intprm[of_contacts, 2].max(initial=0))
        most = _LEAST_MATCHES
        while most < 2 * slots:
            most *= 2
        self._m.opt.contact_sensor_maxmatch = most
        self._in_order: Callable[[], AbstractContextManager[None]] = nullcontext
        is_ordered = options.deterministic and self.device.type in _UNORDERED
        if is_ordered:
            if self.device.type == "cuda":
                repeat_torch()
            from wheelleg_exp.sim.warp_order import FixedOrder

            with self._graphs.here():
                self._in_order = FixedOrder(model, self._m, self._d).active
        self._data = DataFields(wp, self._d, model)
        self._fields = ModelFields(wp, self._m, model, num_envs)
        self._state = self._data.state()
        data = mujoco.MjData(self.model)
        self._initial: dict[str, torch.Tensor] = {}
        for name, view in self._state.items():
            value = torch.as_tensor(getattr(data, name)).reshape(1, *view.shape[1:])
            self._initial[name] = value.to(self.device, view.dtype)
            view.copy_(self._initial[name].expand_as(view))
        self._overflow = Overflow(mjw.OverflowType, wp.to_torch(self._d.overflow), self.room, is_ordered)
        self._current: set[str] = set()
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._all_ids = torch.arange(num_envs, device=self.device)
        from wheelleg_exp.sim import warp_kernels

        self._kernels, flat, self._bad_flags = warp_kernels, warp_kernels.flat, wp.from_torch(self._bad)
        numbers = {name: view for name, view in self._state.items() if view.dtype is torch.float32 and view.numel()}
        most_kept = dict.fromkeys(_MOTION, _HUGE)
        # ``_rows`` has (array, initial values, limit) per state field; a reset keeps only numbers x with |x| < limit.
        self._rows = {n: (flat(v), flat(self._initial[n])[0], most_kept.get(n, 0.0)) for n, v in numbers.items()}
        self._still: set[int] = set()
        self._has_sensors = bool((model.sensor_type != int(mujoco.mjtSensor.mjSENS_CONTACT)).any())

    @property
    def state(self) -> torch.Tensor:  # type: ignore[override]  # read-only
        """A copy of all state fields (qpos, qvel, ...), with one row per simulation, (N, k)."""
        return torch.cat([value.reshape(self.num_envs, -1).float() for value in self._state.values()], dim=1)

    def view(self, name: str) -> torch.Tensor:
        return self._data.view(name)

    def derived(self, name: str) -> torch.Tensor:
        view = self.view(name)
        if name not in self._current:
            if name not in DERIVED:
                message = f"the engine 'warp' cannot update the quantity '{name}' in each physics step"
                raise ConfigError(message, key=ENGINE, expected="mujoco")
            self._current.add(name)
            self._graphs.forget()
            self.forward()
        return view

    def may_differ(self, name: str) -> bool:
        return self._fields.may_differ(name)

    def promise(self) -> dict[str, object]:
        found = {**super().promise(), "nconmax": self.room.contacts, "njmax": self.room.rows}
        because = "the order of contacts and sums differs from run to run without env.sim.deterministic=true"
        return {**found, "because": None if self.exact else because}

    def expand(self, name: str) -> torch.Tensor:
        self.asked.add(name)
        if name not in self.expanded:
            self._graphs.forget()
            self.expanded[name] = self._fields.expand(name)
        return self.expanded[name]

    def set_const(self) -> None:
        if not self._fields.own.keys() >= {"body_subtreemass"}:
            # ``expand`` replaces arrays that the captured CUDA graphs use, so discard these graphs.
            self._graphs.forget()
            for name in (n for n in CONSTANTS if (array := getattr(self._m, n, None)) is not None and array.size):
                self._fields.expand(name)
        self._graphs.run("set_const", lambda: self._mjw.set_const(self._m, self._d))
        self.forward()

    def step(self) -> None:
        """Advance every simulation by one physics step; on a GPU, SimulationFailure comes one or two steps late."""
        if not self._graphs.is_capturing:
            self.require_room()
        self._graphs.run("step", self._advance)
        if self.device.type == "cpu":
            self._overflow.look()
            self._overflow.require_none(self._d)

    @property
    def is_captured(self) -> bool:
        return self._captures

    def require_room(self) -> None:
        self._overflow.require_none(self._d)

    def _advance(self) -> None:
        with self._in_order():
            self._mjw.step(self._m, self._d)
        if self._current:
            self._derive()

    def forward(self, ids: torch.Tensor | None = None) -> None:
        del ids  # Recompute the outputs of all simulations, because selecting ``ids`` on a GPU takes longer.
        if self._current:
            self._graphs.run("forward", self._derive)

    def _derive(self) -> None:
        mjw, m, d = self._mjw, self._m, self._d
        mjw.kinematics(m, d)
        mjw.com_pos(m, d)
        mjw.com_vel(m, d)
        if self._has_sensors:
            mjw.sensor_pos(m, d)
            mjw.sensor_vel(m, d)

    def reset(self, ids: torch.Tensor) -> None:
        with self._graphs.here():
            rows = self._wp.from_torch(ids)
            for values, initial, most in self._rows.values():
                self._launch(self._kernels.restore, (len(ids), values.shape[1]), rows, values, initial, most)
        for name, view in self._state.items():
            if name not in self._rows:
                view.index_copy_(0, ids, self._initial[name].expand(len(ids), *view.shape[1:]))
        self._bad.index_fill_(0, ids, False)

    def _launch(self, kernel: Any, dim: int | tuple[int, int], *inputs: Any) -> None:
        self._wp.launch(kernel, dim=dim, inputs=inputs, device=self._graphs.place)

    def total(self, rows: torch.Tensor | slice) -> torch.Tensor:
        """Return 0 if all positions and velocities of the simulations ``rows`` are finite, otherwise NaN."""
        total = torch.zeros(1, device=self.device)
        ids = rows if isinstance(rows, torch.Tensor) and rows.dtype is torch.int64 else self._all_ids[rows]
        with self._graphs.here():
            found, ids_there = self._wp.from_torch(total), self._wp.from_torch(ids)
            for values in (self._rows[name][0] for name in _MOTION if name in self._rows):
                self._launch(self._kernels.spoil, (len(ids), values.shape[1]), values, ids_there, found)
        return total[0]

    def unstable(self) -> torch.Tensor:
        with self._graphs.here():
            for name in (*_MOTION, "ctrl"):
                if name in self._rows:
                    self._launch(self._kernels.note_huge, self.num_envs, self._rows[name][0], _HUGE, self._bad_flags)
        self._overflow.look()
        return self._bad.clone()

    def ray(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: Sequence[int] | None = None,
        ids: torch.Tensor | None = None,
    ) -> torch.Tensor:
        points, ways = origins.to(self.dtype), directions.to(self.dtype)
        # mujoco-warp always casts rays in all simulations, so ignore the results of simulations outside ``ids``.
        if ids is not None:
            shape = (self.num_envs, *points.shape[1:])
            points = points.new_zeros(shape).index_copy_(0, ids, points)
            ways = ways.new_ones(shape).index_copy_(0, ids, ways)
        wp, count = self._wp, points.shape[1]
        far = torch.empty(self.num_envs, count, device=self.device)
        geoms = torch.empty(self.num_envs, count, dtype=torch.int32, device=self.device)
        normals = torch.empty(self.num_envs, count, 3, device=self.device)
        nobody = torch.full((count,), -1, dtype=torch.int32, device=self.device)
        groups = range(mujoco.mjNGROUP)
        mask = [-1.0 if geom_groups is None else float(group in geom_groups) for group in groups]
        chosen = wp.types.vector(length=mujoco.mjNGROUP, dtype=float)(*mask)
        with self._graphs.here():
            if geom_groups is None or not self._still.issuperset(geom_groups):
                self._mjw.kinematics(self._m, self._d)
            rays = [wp.from_torch(vectors.contiguous(), dtype=wp.vec3) for vectors in (points, ways)]
            found = (wp.from_torch(far), wp.from_torch(geoms), wp.from_torch(normals, dtype=wp.vec3))
            self._mjw.rays(self._m, self._d, *rays, chosen, True, wp.from_torch(nobody), *found)
        return far if ids is None else far[ids]

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        del alone  # Compute the poses of static geoms only once, because they never change.
        with self._graphs.here():
            self._mjw.kinematics(self._m, self._d)
        self._still.add(geom_group)

    def state_dict(self) -> dict[str, object]:
        return {
            "state": {name: value.clone() for name, value in self._state.items()},
            "model_fields": {name: value.clone() for name, value in sorted(self._fields.own.items())},
            "asked_for": sorted(self.expanded),
            "unstable": self._bad.clone(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        for name in saved["asked_for"]:
            self.expand(name)
        self._fields.restore(saved["model_fields"])
        self._graphs.forget()
        for name, values in saved["state"].items():
            self._state[name].copy_(values)
        self._bad.copy_(saved["unstable"])
        self.asked.clear()
        self.forward()


class DataFields:
    """The fields of mujoco-warp's data as torch tensors, in MuJoCo's shapes."""

    def __init__(self, wp: ModuleType, data: Any, model: mujoco.MjModel) -> None:
        self._wp, self._data = wp, data
        self._like = mujoco.MjData(model)
        self._views: dict[str, torch.Tensor] = {}

    def view(self, name: str) -> torch.Tensor:
        """Return a view (N, ...) of an MjData field; raise ConfigError if mujoco-warp does not have the field."""
        if name not in self._views:
            array, like = getattr(self._data, name, None), getattr(self._like, name, None)
            if like is None or not isinstance(array, self._wp.array):
                raise ConfigError(f"mujoco-warp does not have the field '{name}'", key=ENGINE, expected="mujoco")
            shape = (int(self._data.nworld), *np.shape(like))
            if array.size:
                self._views[name] = self._wp.to_torch(array).view(shape)
            else:
                self._views[name] = torch.zeros(shape, device=self._wp.device_to_torch(array.device))
        return self._views[name]

    def state(self) -> dict[str, torch.Tensor]:
        """Return views of the data fields that determine the next physics step, by name."""
        names = [name for name in STATE if hasattr(self._like, name) and hasattr(self._data, name)]
        return {name: self.view(name) for name in names if self.view(name).numel()}


class ModelFields:
    """The fields of mujoco-warp's model, each with one value for all simulations or one value per simulation."""

    def __init__(self, wp: ModuleType, on_device: Any, model: mujoco.MjModel, num_envs: int) -> None:
        self._wp, self._on_device, self._model, self._num_envs = wp, on_device, model, num_envs
        self.own: dict[str, torch.Tensor] = {}
        self._first: dict[str, torch.Tensor] = {}

    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value per simulation; return its tensor (N, ...), or raise ConfigError."""
        if name not in self.own:
            owner, last = self._place(name)
            array: Any = getattr(owner, last, None)
            if not self.may_differ(name):
                expected = "mujoco, or no event that gives each environment its own value"
                message = f"mujoco-warp has only one value of '{name}' for all simulations"
                raise ConfigError(message, key=ENGINE, expected=expected)
            wp = self._wp
            each = wp.zeros((self._num_envs, *array.shape[1:]), dtype=array.dtype, device=array.device)
            wp.to_torch(each).copy_(wp.to_torch(array).expand_as(wp.to_torch(each)))
            setattr(owner, last, each)
            self.own[name] = wp.to_torch(each).view(self._num_envs, *np.shape(self._like(name)))
            self._first[name] = self.own[name][:1].clone()
        return self.own[name]

    def restore(self, saved: Mapping[str, torch.Tensor]) -> None:
        """Restore all model fields with one value per simulation from ``saved``; missing fields get initial values."""
        for name in saved:
            self.expand(name)
        for name, values in self.own.items():
            values.copy_(saved.get(name, self._first[name]).expand_as(values))

    def _like(self, name: str) -> Any:
        found: Any = self._model
        for part in name.split("."):
            found = getattr(found, part, None)
        return found

    def may_differ(self, name: str) -> bool:
        """Return whether an array of mujoco-warp has a leading dimension for the simulations."""
        owner, last = self._place(name)
        array, like = getattr(owner, last, None), self._like(name)
        if like is None or not isinstance(array, self._wp.array) or array.shape[0] not in (1, self._num_envs):
            return False
        return bool(self._wp.to_torch(array).numel() == array.shape[0] * np.size(like))

    def _place(self, name: str) -> tuple[Any, str]:
        holder, _, last = name.rpartition(".")
        return (getattr(self._on_device, holder) if holder else self._on_device), last
