"""Spy managers for the tests of the environment."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from managers import spies


@pytest.fixture(autouse=True)
def _spies(allow_test_terms: None) -> Iterator[None]:
    spies.clear()
    yield
    spies.clear()
