"""The command ``wheelleg convert``, its options, and its output."""

import json
import subprocess
import sys

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.paths import find_asset

from .small_usd import cube_inside, hinge, link, write

STOCK = str(find_asset("wheelleg/wheelleg.usda"))


def test_writes_the_model_and_reports_joints_in_si_units_and_as_authored(tmp_path, capsys):
    output = tmp_path / "robot.xml"
    assert main(["convert", STOCK, "-o", str(output)]) == 0
    told = capsys.readouterr().out
    assert output.is_file()
    for words in ("7, 0.5 kg in all", "Left out", f"Wrote {output}", "--mjcf="):
        assert words in told
    assert told.splitlines()[0] == "wheelleg.usda: converted without doubts"
    table = told.split("Joints\n")[1].split("\n\n")[0]
    rows = {line.split()[0]: " ".join(line.split()[1:]) for line in table.splitlines()}
    assert rows["joint"] == "kind range kp kv effort as authored"
    assert rows["l01"].startswith("hinge -0.5 to 1.7 rad 3 0.3 2 N m -28.65 to 97.4 deg; 0.05236,")
    assert rows["l03"] == "hinge unlimited 1 9 N m 0.01745 per deg"
    assert rows["order"] == "in PhysX: l01, r01, l02, r02, l03, r03"


def test_a_statement_about_many_prims_is_printed_once(tmp_path, capsys):
    body = "".join(link(f"b{i}", f"({i}, 0, 0)", inside=cube_inside("sdf")) for i in range(50))
    body += "".join(hinge(f"j{i}", f"b{i}", f"b{i + 1}") for i in range(49))
    assert main(["convert", str(write(tmp_path, body)), "-o", str(tmp_path / "robot.xml")]) == 0
    told = capsys.readouterr().out.splitlines()
    assert sum("approximation 'sdf'" in line for line in told) == 1
    assert any("/bot/b0/block and 49 more" in line for line in told)
    assert "and 9 more; --json lists them all" in told
    assert sum(line.startswith("j") for line in told) == 41  # heading, 40 joints
    assert max(len(line) for line in told if str(tmp_path) not in line) <= 100


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["absent.usda"], "-o/--output"),
        (["absent.usda", "-o", "out.xml"], "there is no file 'absent.usda'"),
        (["absent.usda", "-o", "out.xml", "--base", "wheels"], "floating"),
        ([STOCK, "-o", "out.xml", "--variant", "Physics=None"], "has no articulation"),
        ([STOCK, "-o", "out.xml", "--variant", "Physics"], "SET=NAME"),
        ([STOCK, "-o", "out.xml", "--variant", "Sensors=None"], "did you mean 'Sensor'?"),
    ],
)
def test_missing_or_wrong_arguments_give_status_2_and_one_line(tmp_path, capsys, monkeypatch, words, told):
    monkeypatch.chdir(tmp_path)
    assert main(["convert", *words]) == 2
    captured = capsys.readouterr()
    assert told in captured.err
    assert (captured.err.count("\n"), captured.out) == (1, "")
    assert not list(tmp_path.iterdir())


def test_json_is_one_document_and_nothing_else(tmp_path, capsys):
    assert main(["convert", STOCK, "-o", str(tmp_path / "robot.xml"), "--base", "fixed", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["totals"]["bodies"], report["base"]) == (7, "fixed")


def test_help_loads_neither_usd_nor_mujoco():
    code = "import sys, wheelleg_exp.cli.convert, wheelleg_exp.asset as asset\n"
    code += "print({'pxr', 'mujoco'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
