"""Terms that each break one reproducibility promise, and one term that breaks no promise."""

import os
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import torch

_steps: WeakKeyDictionary[Any, int] = WeakKeyDictionary()


def _constant(env: Any, value: float) -> torch.Tensor:
    return torch.full((env.num_envs,), float(value))


def entropy(env: Any) -> torch.Tensor:
    """Draw random numbers from the operating system, not from a named stream."""
    return _constant(env, os.urandom(1)[0] / 255.0)


def torch_threads(env: Any) -> torch.Tensor:
    """Depend on torch's threads."""
    return _constant(env, torch.get_num_threads())


def physics_threads(env: Any) -> torch.Tensor:
    """Depend on MuJoCo's threads."""
    return _constant(env, env.scene.sim.nthread)


def observers(env: Any) -> torch.Tensor:
    """Depend on whether somebody records."""
    return _constant(env, len(env.observers))


def hidden_steps(env: Any) -> torch.Tensor:
    """Count steps in a variable that no ``state_dict`` contains."""
    _steps[env] = _steps.get(env, 0) + 1
    return _constant(env, _steps[env] / 100.0)


def outside_file(env: Any) -> torch.Tensor:
    """Read a file that the run's snapshot does not contain."""
    return _constant(env, float(Path(os.environ["PLANTED_FILE"]).read_text()))


def own_draw(env: Any, env_ids: torch.Tensor, generator: torch.Generator) -> None:
    """Draw random numbers from the term's own stream, and change no state."""
    torch.rand(len(env_ids), generator=generator)


def global_draw(env: Any, env_ids: torch.Tensor) -> None:
    """Draw random numbers from torch's global generator, and change no state."""
    torch.rand(len(env_ids))


def borrowed_draw(env: Any, env_ids: torch.Tensor) -> None:
    """Draw random numbers from the stream of a different term, and change no state."""
    torch.rand(len(env_ids), generator=env.streams.get("env.events.reset_base"))
