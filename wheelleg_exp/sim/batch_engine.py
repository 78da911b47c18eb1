"""The physics engine ``mujoco`` runs many simulations in parallel on the CPU, in float64, with ``mujoco.batch``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from mujoco.batch import Batch, SimulationError

from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.machine import usable_cores
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import not_finite
from wheelleg_exp.sim.options import RobotOptions, SimOptions
from wheelleg_exp.state import cloned

_STAGE_NONE = mujoco.mjtStage.mjSTAGE_NONE.value
_STAGE_VEL = mujoco.mjtStage.mjSTAGE_VEL.value
_UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC", "CTRL")]


class BatchEngine(Engine):
    """N simulations on the CPU; each physics step is bit-identical to MuJoCo's ``mj_step``.

    ``nthread`` does not change the results; 0 means one physics thread for each CPU core that the process may use.
    """

    name = "mujoco"
    exact = True

    @classmethod
    def from_config(cls, model: mujoco.MjModel, num_envs: int, sim: SimOptions, robot: RobotOptions, /) -> Engine:
        del robot
        return cls(model, num_envs, sim.nthread)

    def __init__(self, model: mujoco.MjModel, num_envs: int, nthread: int) -> None:
        # Stop MuJoCo from writing the log file MUJOCO_LOG.TXT into the current folder.
        config = mujoco.MjLogConfig.get()
        config.logto_file = False
        config.set()
        self.model = model
        self.num_envs = num_envs
        self.device = torch.device("cpu")
        self.dtype = torch.float64
        self.batch = Batch(model, num_envs, nthread=nthread or usable_cores())
        self.nthread = self.batch.nthread
        self._views: dict[str, torch.Tensor] = {}
        self.expanded = {}
        self.asked = set()
        self._still: dict[tuple[int, ...], StaticGeoms] = {}
        self._unedited: dict[str, torch.Tensor] = {}
        self._at_set_const: dict[str, torch.Tensor] | None = None
        self.state = torch.from_numpy(self.batch.state)
        self._current: set[str] = set()
        self._all_warnings = torch.from_numpy(self.batch.warning)
        self._warnings = self._all_warnings[:, min(_UNSTABLE) : max(_UNSTABLE) + 1, 1]
        self._initial = self.state[0:1].clone()
        # In MuJoCo's state vector, the joint velocities (qvel) follow the joint positions (qpos).
        start = (self.view("qpos").data_ptr() - self.state.data_ptr()) // self.state.element_size()
        self._is_motion = torch.zeros(self.state.shape[1], dtype=torch.bool)
        self._is_motion[start : start + model.nq + model.nv] = True
        self._motion = self.state[:, start : start + model.nq + model.nv]

    @property
    def motion(self) -> torch.Tensor:
        return self._motion

    def view(self, name: str) -> torch.Tensor:
        if name not in self._views:
            with warnings.catch_warnings():  # Hide torch's warning about read-only NumPy arrays.
                warnings.simplefilter("ignore", UserWarning)
                self._views[name] = torch.from_numpy(self.batch.bind(name))
        return self._views[name]

    def derived(self, name: str) -> torch.Tensor:
        view = self.view(name)
        if name not in self._current:
            self._current.add(name)
            self.forward()
        return view

    def expand(self, name: str) -> torch.Tensor:
        self.asked.add(name)
        if name not in self.expanded:
            self.expanded[name] = torch.from_numpy(self.batch.expand(name))
            self._unedited[name] = self.expanded[name].clone()
            if self._at_set_const is not None:  # At the last call of set_const, the field had this value.
                self._at_set_const[name] = self._unedited[name].clone()
        return self.expanded[name]

    def set_const(self) -> None:
        self.batch.set_const()
        self._at_set_const = cloned(self.expanded)

    def step(self) -> None:
        try:
            self.batch.step(nstep=1, stage=_STAGE_VEL if self._current else _STAGE_NONE)
        except SimulationError as error:
            raise SimulationFailure(f"physics failed: {error}") from error

    def forward(self, ids: torch.Tensor | None = None) -> None:
        if self._current:
            self.batch.forward(None if ids is None else ids.numpy(), stage=_STAGE_VEL)

    def reset(self, ids: torch.Tensor) -> None:
        rows = self.state.index_select(0, ids)
        rows = torch.where(self._is_motion & rows.isfinite(), rows, self._initial)
        self.state.index_copy_(0, ids, rows)
        self._all_warnings.index_fill_(0, ids, 0)

    def unstable(self) -> torch.Tensor:
        # Before each physics step, MuJoCo resets a simulation with NaN or huge values, and counts a warning.
        # Also search qpos and qvel for NaN and inf, because MuJoCo checks a step's results only in the next step.
        return self._warnings.any(dim=1) | not_finite(self._motion.sum(dim=1))

    def total(self, rows: torch.Tensor | slice) -> torch.Tensor:
        return (self.state.index_select(0, rows) if isinstance(rows, torch.Tensor) else self.state[rows]).sum()

    def ray(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: Sequence[int] | None = None,
        ids: torch.Tensor | None = None,
    ) -> torch.Tensor:
        groups = None if geom_groups is None else np.isin(np.arange(mujoco.mjNGROUP), geom_groups)
        points, vectors = (rays.double().contiguous().numpy() for rays in (origins, directions))
        still = self._still.get(tuple(geom_groups or ()))
        if still is not None and still.are_still(self.expanded):
            return torch.from_numpy(still.ray(points, vectors))
        distances, _ = self.batch.ray(points, vectors, geomgroup=groups, ids=None if ids is None else ids.numpy())
        return torch.from_numpy(distances)

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        self._still[(geom_group,)] = StaticGeoms(self.model, geom_group, alone, self.nthread)

    def state_dict(self) -> dict[str, object]:
        if hidden := sorted(vars(self.batch)["_expanded"].keys() - self.expanded.keys()):
            message = f"a term called MuJoCo's 'Batch.expand' for {' and '.join(hidden)}, which checkpoints do not save"
            raise ConfigError(message, key="env.scene.sim.batch", expected=f"env.scene.sim.expand('{hidden[0]}')")
        at_set_const = None
        if self._at_set_const is not None:
            # Save the old values of model fields that were changed after the last call of MuJoCo's ``set_const``.
            then, now = self._at_set_const, sorted(self.expanded.items())
            at_set_const = {name: then[name].clone() for name, v in now if not torch.equal(then[name], v)}
        return {
            "state": self.state.clone(),
            "warning": torch.from_numpy(self.batch.warning.copy()),
            "model_fields": {name: values.clone() for name, values in sorted(self.expanded.items())},
            "at_set_const": at_set_const,
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        # Repeat the last ``set_const`` call before the checkpoint, with that call's fields; then load all saved fields.
        fields, then = saved["model_fields"], saved["at_set_const"]
        for name in fields:
            self.expand(name)
        now = {**self._unedited, **fields}
        if then is not None or self._at_set_const is not None:
            for name, values in (self._unedited if then is None else {**now, **then}).items():
                self.expanded[name].copy_(values)
            self.set_const()
        for name, values in now.items():
            self.expanded[name].copy_(values)
        if then is None:
            self._at_set_const = None
        self.state.copy_(saved["state"])
        self.batch.warning[...] = saved["warning"].numpy()
        self.asked.clear()
        self.forward()


_MARGIN = 1e-6  # The bounding boxes of geoms are enlarged by 1e-6 m because of rounding errors.

Floats = npt.NDArray[np.float64]


class GeomBoxes:
    """The axis-aligned boxes around the static geoms of a model; the box around a plane is infinite."""

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        turn = data.geom_xmat.reshape(-1, 3, 3)
        middle = data.geom_xpos + np.einsum("gij,gj->gi", turn, model.geom_aabb[:, :3])
        half = np.einsum("gij,gj->gi", np.abs(turn), model.geom_aabb[:, 3:]) + _MARGIN
        ends = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
        self._low = np.where(ends[:, None], middle - half, -np.inf)
        self._high = np.where(ends[:, None], middle + half, np.inf)
        self._all_low = self._low[ends].min(axis=0, initial=np.inf)
        self._all_high = self._high[ends].max(axis=0, initial=-np.inf)

    def reached(self, origins: Floats, directions: Floats) -> npt.NDArray[np.bool_]:
        """Return a mask (n, G) of the geoms that the R rays of each of n blocks may hit."""
        low, high = self._spans(origins, directions)
        low, high = low.min(axis=1), high.max(axis=1)
        found = np.ones((len(origins), len(self._low)), dtype=np.bool_)
        for axis in range(3):  # Looping over x, y, and z is faster than comparing arrays (..., 3) at once.
            found &= low[:, axis, None] <= self._high[:, axis]
            found &= high[:, axis, None] >= self._low[:, axis]
        return found

    def _spans(self, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
        """Return the box around each ray's section inside the bounding box of all geoms, as two corners (n, R, 3).

        Computed with the slab method (Kay and Kajiya 1986). A ray that misses has the corners inf and -inf.
        """
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            slope = 1.0 / np.where(directions == 0.0, 1e-300, directions)
            one, other = (self._all_low - origins) * slope, (self._all_high - origins) * slope
            enters = np.minimum(one, other).max(axis=2, initial=0.0, keepdims=True)
            leaves = np.maximum(one, other).min(axis=2, keepdims=True)
            start, end = origins + enters * directions, origins + leaves * directions
        meets = enters <= leaves
        low = np.where(meets, np.minimum(start, end) - _MARGIN, np.inf)
        return low, np.where(meets, np.maximum(start, end) + _MARGIN, -np.inf)


_GEOM_FIELDS = ("geom_type", "geom_size", "geom_pos", "geom_quat")
_ROWS = 32  # simulations per thread
_MANY = 8  # If there are at least 8 geoms, a ray is tested only against geoms whose bounding box it can hit.
_TOGETHER = 48  # rays in a block
_SHOWN, _HIDDEN = 0, 1  # geom groups


class StaticGeoms:
    """Casts rays against a group of static geoms, whose poses and sizes are the same in all simulations.

    MuJoCo tests each ray against every geom, so these rays are cast in a smaller model without the robot, ``alone()``.
    """

    def __init__(self, model: mujoco.MjModel, group: int, alone: Callable[[], mujoco.MjModel], nthread: int) -> None:
        self._model, self._group, self._make, self._nthread = model, group, alone, nthread
        self._batch: Batch | None = None
        self._reach: GeomBoxes | None = None
        self._is_same: bool | None = None

    def are_still(self, expanded: Collection[str]) -> bool:
        """Return False if an event has edited a static geom, because rays must then be cast in the complete model."""
        if self._is_same is None:
            alone, here = self._make(), np.flatnonzero(self._model.geom_group == self._group)
            self._is_same = len(here) == alone.ngeom
            there = [alone.geom(self._model.geom(g).name).id for g in here if self._is_same]
            for name in _GEOM_FIELDS:
                own, other = getattr(self._model, name)[here], getattr(alone, name)[there]
                self._is_same = self._is_same and np.array_equal(own, other)
            if self._is_same:
                self._batch = Batch(alone, self._nthread * _ROWS, nthread=self._nthread)
                if alone.ngeom >= _MANY:
                    self._reach, self._groups = GeomBoxes(alone), self._batch.expand("geom_group")
        return self._is_same and not any(name in expanded for name in _GEOM_FIELDS)

    def ray(self, origins: Floats, directions: Floats) -> Floats:
        """Cast rays (n, R, 3); return the distance to each ray's first hit, (n, R), like the method ``Engine.ray``."""
        rows, shape = self._nthread * _ROWS, origins.shape[:-1]
        count = int(np.prod(shape))
        together = _TOGETHER if self._reach else max(1, -(-count // rows))
        blocks = -(-count // together)
        flat = (np.resize(rays.reshape(-1, 3), (blocks * together, 3)) for rays in (origins, directions))
        starts, ways = (rays.reshape(blocks, together, 3) for rays in flat)
        far = np.empty((blocks, together))
        assert self._batch is not None
        for some in (slice(first, min(first + rows, blocks)) for first in range(0, blocks, rows)):
            # Each simulation of the MuJoCo batch casts one row of the rays in ``starts[some]`` and ``ways[some]``.
            ids, shown = np.arange(some.stop - some.start), None
            if self._reach is not None:
                self._groups[: len(ids)] = np.where(self._reach.reached(starts[some], ways[some]), _SHOWN, _HIDDEN)
                shown = np.arange(mujoco.mjNGROUP) == _SHOWN
            far[some] = self._batch.ray(starts[some], ways[some], geomgroup=shown, ids=ids)[0]
        return far.reshape(-1)[:count].reshape(shape)
