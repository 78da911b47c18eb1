"""Spies for the tests of the managers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from sim.small_envs import start_env as start_env

from managers import spies


@pytest.fixture(autouse=True)
def _spies(allow_test_terms: None) -> Iterator[None]:
    spies.clear()
    yield
    spies.clear()
