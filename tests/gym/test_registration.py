"""Gymnasium knows the environments whichever package is imported first, and the package does not wait for it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from patience import PATIENCE_S

KNOWN = "assert 'Wheelleg-Velocity-v0' in gymnasium.registry"


@pytest.mark.parametrize(
    "code",
    [
        f"import gymnasium, wheelleg_exp; {KNOWN}",
        f"import wheelleg_exp, sys; assert 'gymnasium' not in sys.modules; import gymnasium; {KNOWN}",
        f"import wheelleg_exp; from gymnasium import spaces; import gymnasium; {KNOWN}",
    ],
)
def test_the_environments_are_registered(code):
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)
