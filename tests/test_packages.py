"""The content of a wheel, and the bounds of its dependencies."""

import tomllib
from importlib.metadata import requires
from pathlib import Path

import yaml
from packaging.requirements import Requirement

import wheelleg_exp

ROOT = Path(__file__).resolve().parents[1]


def test_every_package_is_in_the_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = set(project["tool"]["setuptools"]["packages"]) - set(project["tool"]["setuptools"]["package-dir"])
    found = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "wheelleg_exp").rglob("__init__.py")}
    assert listed == found


def test_no_lower_bound_is_below_the_bound_that_a_dependency_sets():
    """rerun-sdk requires numpy 2, so that `numpy>=1.26` would name versions that pip cannot install."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core, extra = project["dependencies"], project["optional-dependencies"]["dev"]
    core, extra = ([Requirement(text) for text in texts] for texts in (core, extra))
    for bounded, installed in ((core, core), (extra, core + extra)):
        lowest = {one.name: spec.version for one in bounded for spec in one.specifier if spec.operator == ">="}
        # If a range has one minor version, the bounds of the installed version are those of every version.
        minor = [one.name for one in installed if any(str(s).startswith("<") and "." in str(s) for s in one.specifier)]
        theirs = [Requirement(text) for name in minor for text in requires(name) if "extra ==" not in text]
        assert [str(one) for one in theirs if one.name in lowest and lowest[one.name] not in one.specifier] == []


def test_citation_and_changelog_name_the_version_and_one_date():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    head = f"## [{wheelleg_exp.__version__}] - {citation['date-released']}"
    assert citation["version"] == wheelleg_exp.__version__
    assert head in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()
