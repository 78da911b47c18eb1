"""``wheelleg convert`` as people call it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.paths import find_asset

from .small_usd import link, write


def test_writes_the_model_and_tells_what_became_of_what(tmp_path, capsys):
    output = tmp_path / "robot.xml"
    assert main(["convert", str(find_asset("wheelleg/wheelleg.usda")), "-o", str(output)]) == 0
    told = capsys.readouterr().out
    assert output.is_file()
    for words in ("7, 0.5 kg in all", "l01 r01 l02 r02 l03 r03", "Left out", f"Wrote {output}"):
        assert words in told


def test_json_is_one_document_and_nothing_else(tmp_path, capsys):
    source = str(find_asset("wheelleg/wheelleg.usda"))
    assert main(["convert", source, "-o", str(tmp_path / "robot.xml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["totals"]["bodies"] == 7


def test_base_is_passed_on(tmp_path, capsys):
    source = str(write(tmp_path, link("a")))
    assert main(["convert", source, "-o", str(tmp_path / "b.xml"), "--base", "fixed", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["base"] == "fixed"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--variant", "Physics=None"], "has no articulation"),
        (["--variant", "Physics"], "SET=NAME"),
        (["--variant", "Sensors=None"], "did you mean 'Sensor'?"),
    ],
)
def test_mistakes_end_with_2_and_one_line(tmp_path, capsys, words, told):
    source = str(find_asset("wheelleg/wheelleg.usda"))
    assert main(["convert", source, "-o", str(tmp_path / "robot.xml"), *words]) == 2
    captured = capsys.readouterr()
    assert told in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not list(tmp_path.iterdir())


def test_help_loads_neither_usd_nor_mujoco():
    code = "import sys, wheelleg_exp.cli.convert, wheelleg_exp.asset as asset\n"
    code += "print({'pxr', 'mujoco'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
