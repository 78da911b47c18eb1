"""Access the fields of mujoco-warp's model and data as torch tensors in MuJoCo's shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.warp_runtime import ENGINE

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


class DataFields:
    """The fields of mujoco-warp's data as torch tensors, in MuJoCo's shapes."""

    def __init__(self, wp: Any, data: Any, model: mujoco.MjModel) -> None:
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

    def __init__(self, wp: Any, on_device: Any, model: mujoco.MjModel, num_envs: int) -> None:
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
