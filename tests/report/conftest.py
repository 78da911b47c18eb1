import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from report.pages import Page
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.report import make_report, plot_images
from wheelleg_exp.report.page_blocks import Plot
from wheelleg_exp.run.run_directory import RunDirectory

Reporter = Callable[..., Page]


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "drawings_too" not in request.fixturenames:
        monkeypatch.setattr(plot_images, "_plot", lambda panel: Plot(None, panel.title))


@pytest.fixture
def drawings_too() -> None:
    """A mark of the tests that check drawings; other tests skip the slow drawing."""


@functools.cache
def _composed(overrides: tuple[str, ...], primary: str, config_dirs: tuple[Path, ...]) -> Composed:
    return compose(overrides, primary=primary, config_dirs=config_dirs)


@pytest.fixture(autouse=True)
def _compose_once(monkeypatch: pytest.MonkeyPatch) -> None:

    def once(
        overrides: Sequence[str] = (), *, primary: str = "train", config_dirs: Sequence[Path] = (), **more: Any
    ) -> Composed:
        if more:
            return compose(overrides, primary=primary, config_dirs=config_dirs, **more)
        return _composed(tuple(overrides), primary, tuple(config_dirs))

    monkeypatch.setattr("wheelleg_exp.report.settings_section.compose", once)
    monkeypatch.setattr("report.runs.compose", once)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def page(root: Path) -> Reporter:
    def report(run: RunDirectory | Path) -> Page:
        made = make_report(Path(run), root, pictures=False)
        return Page(made.path.read_text())

    return report
