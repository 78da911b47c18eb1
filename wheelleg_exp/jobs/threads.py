"""The thread policy of torch, and what of it a run records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError


def set_threads(agent: Mapping[str, Any], physics_threads: int) -> dict[str, Any]:
    """Set torch's threads from ``agent.torch_threads`` and return what a run records of threads and CPU.

    Raises:
        ConfigError: the number is not a whole number of at least 1.
    """
    wanted = agent["torch_threads"]
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise ConfigError(f"is {wanted!r}", key="agent.torch_threads", expected="a whole number of at least 1")
    torch.set_num_threads(wanted)
    return {
        "torch": torch.get_num_threads(),
        "physics": physics_threads,
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "device": str(agent["device"]),
    }
