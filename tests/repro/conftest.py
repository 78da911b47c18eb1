"""One folder, one cache of converted robots, and one plain training for all proofs."""

from pathlib import Path

import pytest

from repro.runs import Lab


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("repro")


@pytest.fixture(scope="session")
def lab(folder: Path) -> Lab:
    made = folder / "plain"
    made.mkdir()
    return Lab(made, environ={"WHEELLEG_CACHE": str(folder / "cache")})


@pytest.fixture
def planted(folder: Path, tmp_path: Path):
    def make(term: str, **environ: str) -> Lab:
        node = f"+env.rewards.planted={{_target_: planted.terms.{term}, weight: 1.0}}"
        return Lab(tmp_path, [node], {"WHEELLEG_CACHE": str(folder / "cache"), **environ})

    return make
