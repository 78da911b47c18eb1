"""Where the engine's tests run: Warp's CPU device, or the GPU that `nox -s gpu` names."""

from __future__ import annotations

import os

import pytest

pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed: pip install 'wheelleg_exp[gpu]'")


@pytest.fixture(scope="session")
def device() -> str:
    """Return the device under test."""
    return os.environ.get("WHEELLEG_TEST_DEVICE", "cpu")
