import pytest

from wheelleg_exp.env import ManagerBasedRLEnv

from .worlds import config


@pytest.fixture
def world(tmp_path):
    def build(mjcf, dt, base="floating", **changes):
        path = tmp_path / "robot.xml"
        path.write_text(mjcf)
        return ManagerBasedRLEnv(config(dt, base, **changes), path, 0)

    return build
