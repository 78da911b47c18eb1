"""Bundles and logs that several tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from jobs.small import cache_of

from .made import Columns, bundle_of, drive


@pytest.fixture(autouse=True, scope="session")
def _cache(tmp_path_factory):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def stand(tmp_path_factory, _cache) -> tuple[Path, dict[str, Any], Path]:
    return bundle_of("article", tmp_path_factory.mktemp("stand"))


@pytest.fixture(scope="session")
def clean(stand) -> Columns:
    return drive(stand[0], seconds=5.0)
