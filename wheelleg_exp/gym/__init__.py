"""Gymnasium's interfaces: ``gymnasium.make`` and ``gymnasium.make_vec`` of ``Wheelleg-Velocity-v0``.

| module | what it offers |
|---|---|
| `task_env` | the environment of a task, its spaces, and images for `render_mode="rgb_array"` |
| `single_env`, `vector_env` | the single and the vector environment |
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ENV_ID = "Wheelleg-Velocity-v0"
_GYMNASIUM = "gymnasium"


def register() -> None:
    """Register the environments with Gymnasium."""
    from gymnasium.envs.registration import register as register_in_gymnasium
    from gymnasium.envs.registration import registry

    if ENV_ID not in registry:
        register_in_gymnasium(
            ENV_ID,
            entry_point="wheelleg_exp.gym.single_env:WheellegEnv",
            vector_entry_point="wheelleg_exp.gym.vector_env:WheellegVectorEnv",
        )


def register_with_gymnasium() -> None:
    """Register the tasks' environments if Gymnasium is already imported, or as soon as Gymnasium is imported.

    Importing Gymnasium takes a quarter of a second, so this package does not import Gymnasium itself.
    """
    if _GYMNASIUM in sys.modules:
        register()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder(MetaPathFinder):
    """Register the tasks' environments as soon as Gymnasium is imported."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        del path, target
        if name != _GYMNASIUM:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = _RegisteringLoader(spec.loader)
        return spec


class _RegisteringLoader(Loader):
    """Load Gymnasium with Gymnasium's standard loader, and then register the tasks' environments."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        register()
