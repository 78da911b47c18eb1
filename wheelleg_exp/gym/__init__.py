"""The Gymnasium faces: ``gymnasium.make`` and ``gymnasium.make_vec`` of ``Wheelleg-Velocity-v0``."""

from __future__ import annotations

from gymnasium.envs.registration import register as register_in_gymnasium
from gymnasium.envs.registration import registry

ENV_ID = "Wheelleg-Velocity-v0"


def register() -> None:
    """Register the environments; importing the package does it."""
    if ENV_ID not in registry:
        register_in_gymnasium(
            ENV_ID,
            entry_point="wheelleg_exp.gym.single_env:WheellegEnv",
            vector_entry_point="wheelleg_exp.gym.vector_env:WheellegVectorEnv",
        )
