"""What a wheel holds."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_package_is_in_the_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = set(project["tool"]["setuptools"]["packages"]) - set(project["tool"]["setuptools"]["package-dir"])
    found = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "wheelleg_exp").rglob("__init__.py")}
    assert listed == found
