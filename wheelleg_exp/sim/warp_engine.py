"""The engine ``warp``: simulations on an NVIDIA GPU with mujoco-warp, in float32."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.options import SimOptions
from wheelleg_exp.sim.warp_fields import DERIVED, DataFields, ModelFields
from wheelleg_exp.sim.warp_runtime import ENGINE, Graphs, load, put_model

_CONTACTS = 24  # a simulation, on average: a wheel-legged robot that lies on the ground has about twelve
_ON_RELIEF = 48  # a height field or a mesh meets one geom in several points
_GRAIN = 16
_ROWS_OF_EQUALITY = 6


@dataclass(frozen=True)
class Capacity:
    """What a simulation has room for.

    Attributes:
        contacts: contacts; all simulations share the room of all.
        rows: constraint rows; each simulation has its own.
    """

    contacts: int
    rows: int


def capacity_for(model: mujoco.MjModel, nconmax: int, njmax: int) -> Capacity:
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
        return Capacity(contacts, njmax)
    rows_of_contact = 2 * (int(model.geom_condim.max(initial=3)) - 1)  # of a pyramid, the larger of both cones
    rows = contacts * rows_of_contact + model.neq * _ROWS_OF_EQUALITY
    rows += int((model.jnt_limited != 0).sum()) + int((model.dof_frictionloss != 0).sum())
    rows += int((model.tendon_limited != 0).sum()) + int((model.tendon_frictionloss != 0).sum())
    return Capacity(contacts, -(-rows // _GRAIN) * _GRAIN)


class Overflow:
    """Notices that there were more contacts or constraint rows than there is room for, without waiting for a GPU.

    Args:
        kinds: mujoco-warp's enumeration of overflows.
        flags: its flags of each simulation, (N,) int, a live view; nobody clears them.
        room: what there is room for.
    """

    def __init__(self, kinds: Any, flags: torch.Tensor, room: Capacity) -> None:
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


_HUGE = 1e10  # MuJoCo's mjMAXVAL, beyond which it takes a number for wrong
_LEAST_MATCHES = 8
_MOTION = ("qpos", "qvel")


class WarpEngine(Engine):
    """N simulations on mujoco-warp.

    One step of one state agrees with MuJoCo's to single precision. On a GPU the order of contacts and of sums differs
    from run to run, so that two runs from one state drift apart; on the CPU device a run repeats to the bit.

    Args:
        model: the compiled scene.
        num_envs: number of simulations, N.
        options: the ``env.sim`` section.

    Raises:
        ConfigError: a package or a device is not there, or the model has what mujoco-warp does not simulate.
    """

    name = "warp"

    def __init__(self, model: mujoco.MjModel, num_envs: int, options: SimOptions) -> None:
        self.model = model
        self.num_envs = num_envs
        self.device = torch.device(options.device)
        if self.device.type == "cuda":
            self.device = torch.device("cuda", self.device.index or 0)
        self.dtype = torch.float32
        self.nthread = 1
        self.exact = self.device.type == "cpu"
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
        self._m.opt.warn_overflow = 0  # told by an error, not by a print of the kernel
        self._m.opt.contact_sensor_maxmatch = _most_matches(model)
        self._data = DataFields(wp, self._d, model)
        self._fields = ModelFields(wp, self._m, model, num_envs)
        self._state = self._data.state()
        self._initial = self._first_state()
        for name, value in self._initial.items():
            self._state[name].copy_(value.expand_as(self._state[name]))
        self._overflow = Overflow(mjw.OverflowType, wp.to_torch(self._d.overflow), self.room)
        self._current: set[str] = set()
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._all_ids = torch.arange(num_envs, device=self.device)
        self._rows = self._flat_state()
        self._still: set[int] = set()
        kinds = model.sensor_type
        self._has_sensors = bool((kinds != int(mujoco.mjtSensor.mjSENS_CONTACT)).any())

    def _first_state(self) -> dict[str, torch.Tensor]:
        """Return MuJoCo's own first state, (1, ...) by name."""
        data = mujoco.MjData(self.model)
        found = {}
        for name, view in self._state.items():
            value = torch.as_tensor(getattr(data, name)).reshape(1, *view.shape[1:])
            found[name] = value.to(self.device, view.dtype)
        return found

    def _flat_state(self) -> dict[str, tuple[Any, Any, float]]:
        """Return what a reset works on, for Warp: numbers by name, those at first, and how large they may stay."""
        from wheelleg_exp.sim import warp_kernels  # which imports Warp

        self._kernels = warp_kernels
        self._bad_flags = self._wp.from_torch(self._bad)
        numbers = {name: view for name, view in self._state.items() if view.dtype is torch.float32 and view.numel()}
        return {
            name: (
                warp_kernels.flat(view),
                warp_kernels.flat(self._initial[name])[0],
                _HUGE if name in _MOTION else 0.0,
            )
            for name, view in numbers.items()
        }

    @property
    def state(self) -> torch.Tensor:  # type: ignore[override]  # nobody writes it
        """One row of numbers a simulation, from which its next step follows, (N, k); a copy."""
        return torch.cat([value.reshape(self.num_envs, -1).float() for value in self._state.values()], dim=1)

    def view(self, name: str) -> torch.Tensor:
        """Return a live float32 view (N, ...) of an MjData field (see ``Engine.view``)."""
        return self._data.view(name)

    def derived(self, name: str) -> torch.Tensor:
        """Return a live view (N, ...) of an output that depends on positions and velocities; it is kept current."""
        view = self.view(name)
        if name not in self._current:
            if name not in DERIVED:
                raise ConfigError(f"the engine 'warp' keeps no current '{name}'", key=ENGINE, expected="mujoco")
            self._current.add(name)
            self._graphs.forget()
            self.forward()
        return view

    def may_differ(self, name: str) -> bool:
        """Return whether a model field can have one value a simulation."""
        return self._fields.may_differ(name)

    def promise(self) -> dict[str, Any]:
        """Return what a run records of its engine, and what there was room for."""
        found = {**super().promise(), "nconmax": self.room.contacts, "njmax": self.room.rows}
        return {**found, "because": None if self.exact else "the order of contacts and sums differs from run to run"}

    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value a simulation; return the live tensor (N, ...).

        Raises:
            ConfigError: mujoco-warp holds one value of it for all.
        """
        self.asked.add(name)
        if name not in self.expanded:
            self._graphs.forget()
            self.expanded[name] = self._fields.expand(name)
        return self.expanded[name]

    def set_const(self) -> None:
        """Recompute the constants that are derived from the model fields of each simulation."""
        if not self._fields.own.keys() >= {"body_subtreemass"}:
            self._graphs.forget()
            self._fields.expand_constants()
        self._graphs.run("set_const", self._derive_constants)
        self.forward()

    def _derive_constants(self) -> None:
        self._mjw.set_const(self._m, self._d)

    def step(self) -> None:
        """Advance every simulation by one physics step.

        Raises:
            SimulationFailure: there were more contacts or constraint rows than there is room for; on a GPU it is told
                a step or two later.
        """
        if not self._graphs.is_capturing:
            self.require_room()
        self._graphs.run("step", self._advance)
        if self.device.type == "cpu":
            self._overflow.look()
            self._overflow.require_none(self._d)

    @property
    def is_captured(self) -> bool:
        """Whether an environment's step may be captured as a CUDA graph, the engine's steps within it."""
        return self._captures

    def require_room(self) -> None:
        """Raise SimulationFailure when there were more contacts or constraint rows than there is room for."""
        self._overflow.require_none(self._d)

    def _advance(self) -> None:
        self._mjw.step(self._m, self._d)
        if self._current:
            self._derive()

    def forward(self, ids: torch.Tensor | None = None) -> None:
        """Make derived outputs describe the present state of all; others than ``ids`` have the same values as before.

        Fixed shapes cost a GPU less than choosing rows.
        """
        del ids
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
        """Zero all of ``ids`` but positions and velocities; of these what is NaN or huge."""
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
        """Return 0, or what is no number where positions or velocities of some simulations are not finite."""
        total = torch.zeros(1, device=self.device)
        ids = rows if isinstance(rows, torch.Tensor) and rows.dtype is torch.int64 else self._all_ids[rows]
        with self._graphs.here():
            found, ids_there = self._wp.from_torch(total), self._wp.from_torch(ids)
            for values in (self._rows[name][0] for name in _MOTION if name in self._rows):
                self._launch(self._kernels.spoil, (len(ids), values.shape[1]), values, ids_there, found)
        return total[0]

    def unstable(self) -> torch.Tensor:
        """Return which simulations (N,) bool have gone to NaN or huge values since their reset.

        mujoco-warp goes on with such numbers, which never reach another simulation.
        """
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
        """Return how far rays go before they meet a geom (see ``Engine.ray``).

        Every simulation casts as many; rays of ``ids`` alone are spread over all and taken from them.
        """
        points, ways = origins.to(self.dtype), directions.to(self.dtype)
        if ids is not None:
            shape = (self.num_envs, *points.shape[1:])
            points = points.new_zeros(shape).index_copy_(0, ids, points)
            ways = ways.new_ones(shape).index_copy_(0, ids, ways)
        wp, count = self._wp, points.shape[1]
        far = torch.empty(self.num_envs, count, device=self.device)
        geoms = torch.empty(self.num_envs, count, dtype=torch.int32, device=self.device)
        normals = torch.empty(self.num_envs, count, 3, device=self.device)
        nobody = torch.full((count,), -1, dtype=torch.int32, device=self.device)
        chosen = self._group_mask(geom_groups)
        with self._graphs.here():
            if geom_groups is None or not self._still.issuperset(geom_groups):
                self._mjw.kinematics(self._m, self._d)
            self._mjw.rays(
                self._m,
                self._d,
                wp.from_torch(points.contiguous(), dtype=wp.vec3),
                wp.from_torch(ways.contiguous(), dtype=wp.vec3),
                chosen,
                True,
                wp.from_torch(nobody),
                wp.from_torch(far),
                wp.from_torch(geoms),
                wp.from_torch(normals, dtype=wp.vec3),
            )
        return far if ids is None else far[ids]

    def _group_mask(self, geom_groups: Sequence[int] | None) -> Any:
        vec6 = self._wp.types.vector(length=mujoco.mjNGROUP, dtype=float)
        if geom_groups is None:
            return vec6(*[-1.0] * mujoco.mjNGROUP)
        return vec6(*[float(group in geom_groups) for group in range(mujoco.mjNGROUP)])

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        """Say that a group's geoms never move: their places need not be computed before a ray is cast."""
        del alone
        with self._graphs.here():
            self._mjw.kinematics(self._m, self._d)
        self._still.add(geom_group)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next step depends on: states and the model fields of each simulation."""
        return {
            "state": {name: value.clone() for name, value in self._state.items()},
            "model_fields": {name: value.clone() for name, value in sorted(self._fields.own.items())},
            "asked_for": sorted(self.expanded),
            "unstable": self._bad.clone(),
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for name in saved["asked_for"]:
            self.expand(name)
        self._fields.restore(saved["model_fields"])
        self._graphs.forget()
        for name, values in saved["state"].items():
            self._state[name].copy_(values)
        self._bad.copy_(saved["unstable"])
        self.asked.clear()
        self.forward()


def _most_matches(model: mujoco.MjModel) -> int:
    """Return how many contacts the contact sensors look at: twice as many as they have room for."""
    of_contacts = model.sensor_type == int(mujoco.mjtSensor.mjSENS_CONTACT)
    slots = int(model.sensor_intprm[of_contacts, 2].max(initial=0))
    most = _LEAST_MATCHES
    while most < 2 * slots:
        most *= 2
    return most
