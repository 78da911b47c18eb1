"""N simulations of one model on a persistent ``mujoco.batch.Batch``, seen as live torch tensors."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError

from wheelleg_exp.errors import SimulationFailure

_STAGE_NONE = mujoco.mjtStage.mjSTAGE_NONE.value
_STAGE_VEL = mujoco.mjtStage.mjSTAGE_VEL.value
_UNSTABLE = [
    int(getattr(mujoco.mjtWarning, name))
    for name in ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")
]


class Simulation:
    """N simulations of one model.

    After every call position- and velocity-dependent fields describe the new state; torques and contact
    forces keep the values of the last solve, which is the convention of PhysX and Isaac Lab.

    Args:
        model: the compiled scene.
        num_envs: number of simulations, N.
        nthread: physics threads (0: all processors); no result depends on it.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, nthread: int) -> None:
        self.model = model
        self.num_envs = num_envs
        self.batch = Batch(model, num_envs, nthread=nthread, persistent=True)
        self._views: dict[str, torch.Tensor] = {}
        self._expanded: dict[str, torch.Tensor] = {}
        self.state = torch.from_numpy(self.batch.state)
        self._stepped = False

    @property
    def nthread(self) -> int:
        """Number of physics threads."""
        return self.batch.nthread

    def view(self, name: str) -> torch.Tensor:
        """Return a live float64 view (N, ...) of an MjData field.

        State fields (``qpos``, ``qvel``, ``ctrl``, ``xfrc_applied``, ...) may be written; others are outputs and
        must only be read.
        """
        if name not in self._views:
            array = self.batch.bind(name)
            with warnings.catch_warnings():  # torch cannot mark a tensor read-only and says so
                warnings.simplefilter("ignore", UserWarning)
                self._views[name] = torch.from_numpy(array)
            if self._stepped and not array.flags.writeable:
                self.forward()  # a field bound late is zero until the next call
        return self._views[name]

    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value a simulation; return the live tensor (N, ...).

        Call ``set_const`` after writing a field that MuJoCo derives constants from (masses, inertias, CoM).
        """
        if name not in self._expanded:
            self._expanded[name] = torch.from_numpy(self.batch.expand(name))
        return self._expanded[name]

    def set_const(self) -> None:
        """Recompute the constants that MuJoCo derives from the model fields of each simulation."""
        self.batch.set_const()

    def step(self) -> None:
        """Advance every simulation by one physics step."""
        try:
            self.batch.step(nstep=1, stage=_STAGE_VEL)
        except SimulationError as error:
            raise SimulationFailure(f"physics failed: {error}") from error
        self._stepped = True

    def forward(self, ids: torch.Tensor | None = None) -> None:
        """Make position- and velocity-dependent fields describe the present state of ``ids`` (all when None)."""
        self.batch.forward(_rows(ids), stage=_STAGE_VEL)
        self._stepped = True

    def reset(self, ids: torch.Tensor | None = None) -> None:
        """Set the state of ``ids`` to the model's defaults, with zero controls, applied forces and warnings."""
        self.batch.reset(_rows(ids), stage=_STAGE_NONE)
        rows = slice(None) if ids is None else ids.numpy()
        self.batch.warning[rows] = 0

    def unstable(self) -> torch.Tensor:
        """Return which simulations (N,) bool the engine found NaN or huge since their reset.

        MuJoCo sets such a simulation to the model's defaults in silence and raises a counter, which is read here.
        """
        number = self.batch.warning[:, _UNSTABLE, 1]
        return torch.from_numpy(number.any(axis=1))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next step depends on: state rows, warnings, per-simulation model fields."""
        fields = {name: values.clone() for name, values in sorted(self._expanded.items())}
        return {
            "state": self.state.clone(),
            "warning": torch.from_numpy(self.batch.warning.copy()),
            "model_fields": fields,
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for name, values in saved["model_fields"].items():
            self.expand(name).copy_(values)
        if saved["model_fields"]:
            self.set_const()
        self.state.copy_(saved["state"])
        self.batch.warning[...] = saved["warning"].numpy()
        self.forward()


def _rows(ids: torch.Tensor | None) -> np.ndarray | None:
    return None if ids is None else ids.numpy()
