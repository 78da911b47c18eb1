"""Bundles and logs that several tests share."""

from pathlib import Path
from typing import Any

import pytest
from jobs.small import shared_cache

from .made import Columns, bundle_of, drive


@pytest.fixture(autouse=True, scope="session")
def _cache(tmp_path_factory):
    with shared_cache(tmp_path_factory, threads=1):
        yield


@pytest.fixture(scope="session")
def stand(tmp_path_factory, _cache) -> tuple[Path, dict[str, Any], Path]:
    return bundle_of("article", tmp_path_factory.mktemp("stand"))


@pytest.fixture(scope="session")
def clean(stand) -> Columns:
    return drive(stand[0], seconds=5.0)
