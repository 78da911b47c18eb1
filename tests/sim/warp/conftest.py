import os

import pytest

pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed: pip install 'wheelleg_exp[gpu]'")


@pytest.fixture(scope="session")
def device() -> str:
    return os.environ.get("WHEELLEG_TEST_DEVICE", "cpu")
