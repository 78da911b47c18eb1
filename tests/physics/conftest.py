"""Environments on robots that a test writes down itself."""

from __future__ import annotations

import pytest

from wheelleg_exp.env import ManagerBasedRLEnv

from .worlds import config


@pytest.fixture
def world(tmp_path):
    """Build an environment: ``world(STONE, dt=0.01, events={...})``."""

    def build(mjcf, dt, base="floating", **changes):
        path = tmp_path / "robot.xml"
        path.write_text(mjcf)
        return ManagerBasedRLEnv(config(dt, base, **changes), path, 0)

    return build
