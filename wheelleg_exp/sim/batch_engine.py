"""The physics engine ``mujoco`` runs many simulations in parallel on the CPU, in float64, with ``mujoco.batch``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError

from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.machine import usable_cores
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import not_finite
from wheelleg_exp.sim.options import RobotOptions, SimOptions
from wheelleg_exp.sim.static_rays import StaticGeoms
from wheelleg_exp.state import cloned

_STAGE_NONE = mujoco.mjtStage.mjSTAGE_NONE.value
_STAGE_VEL = mujoco.mjtStage.mjSTAGE_VEL.value
_UNSTABLE = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC", "CTRL")]


class BatchEngine(Engine):
    """N simulations on the CPU; each physics step is bit-identical to MuJoCo's ``mj_step``.

    The number of physics threads, ``nthread``, does not change the results. The value 0 of ``nthread`` means one
    physics thread for each CPU core that the process may use.
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
            raise ConfigError(
                f"a term called MuJoCo's 'Batch.expand' for {' and '.join(hidden)}, which checkpoints do not save",
                key="env.scene.sim.batch",
                expected=f"env.scene.sim.expand('{hidden[0]}')",
            )
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
