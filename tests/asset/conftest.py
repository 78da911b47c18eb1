"""Fixtures for the corpus of real robots; tests without a corpus are skipped."""

from pathlib import Path
from typing import Any

import pytest

from wheelleg_exp.asset import Conversion, convert
from wheelleg_exp.paths import find_asset

from .corpus import ABSENT, corpus_folder, expectations


@pytest.fixture(scope="session")
def source() -> Path:
    """Return the path of the stock robot."""
    return find_asset("wheelleg/wheelleg.usda")


@pytest.fixture(scope="session")
def conversion(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    return convert(source, tmp_path_factory.mktemp("robot") / "wheelleg.xml")


@pytest.fixture(scope="session")
def corpus(request: pytest.FixtureRequest) -> Path:
    folder = corpus_folder(request.config.getoption("--corpus"))
    if folder is None:
        pytest.skip(ABSENT)
    return folder


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "corpus_asset" not in metafunc.fixturenames:
        return
    items: list[Any] = expectations(corpus_folder(metafunc.config.getoption("--corpus")))
    absent = pytest.param({}, marks=pytest.mark.skip(reason=ABSENT), id="no corpus")
    metafunc.parametrize("corpus_asset", items or [absent], ids=[item["name"] for item in items] or None)
