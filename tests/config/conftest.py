"""Replace the stock configs by a small config tree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import small_tree
from options_stand_in import Experiment

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking import find_mistakes
from wheelleg_exp.config.checking.check_robot_names import RobotNames
from wheelleg_exp.config.composing import config_loader
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.terms import term_binding

ROBOT = RobotNames(["a", "b", "left_hip", "wheel"], ["base", "foot"])


@pytest.fixture
def stock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = small_tree.write(tmp_path / "configs", small_tree.STOCK)
    (tmp_path / "shelf_terms.py").write_text(small_tree.TARGETS, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(config_loader, "configs_dir", lambda: folder)
    monkeypatch.setattr(find_mistakes, "read_names", lambda robot, roots: ROBOT)
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms"))
    monkeypatch.setattr(schema, "Experiment", Experiment)
    return folder


@pytest.fixture
def user(tmp_path: Path) -> Path:
    return small_tree.write(tmp_path / "mine" / "configs", small_tree.USER)


@pytest.fixture
def edit(stock: Path) -> Callable[..., None]:
    """Return a function that replaces a text in a config file, or the whole file."""

    def change(name: str, *texts: str) -> None:
        if len(texts) == 1:
            small_tree.write(stock, {name: texts[0]})
            return
        before = (stock / name).read_text(encoding="utf-8")
        assert texts[0] in before
        (stock / name).write_text(before.replace(texts[0], texts[1]), encoding="utf-8")

    return change


@pytest.fixture
def composed(stock: Path) -> Callable[..., Composed]:
    return lambda *overrides, **named: compose(overrides, **named)
