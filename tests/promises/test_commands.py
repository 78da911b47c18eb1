"""One command line for each option that no other test uses from the command line: see ledger.yaml."""

import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from .golden import REPOSITORY, STOCK_ROBOT, command
from .parsers import COMMANDS
from .runs import of_this_cpu, require_old_code, unpack

SHORT = "protocol=stand protocol.stand.episodes=2 protocol.stand.horizon_s=1.5 protocol.stand.survival_s=[0.5]"
TINY = "env.num_envs=2 env.sim.nthread=1 agent.torch_threads=1"
BRIEF = f"{TINY} agent.max_iterations=1 agent.num_steps_per_env=4 recording.enabled=false"


@dataclass(frozen=True)
class Line:
    """A command line, with a regular expression for its output, a file that it writes, and its exit status.

    ``words`` are the words after ``wheelleg``. In them, ``{run}``, ``{robot}`` and ``{urdf}`` are files of the test.
    """

    words: str
    output: str = ""
    file: str = ""
    status: int = 0
    marks: tuple[str, ...] = ()

    @property
    def options(self) -> set[str]:
        return {word.partition("=")[0] for word in self.words.split() if word.startswith("-")}


ELSEWHERE = "--root elsewhere/runs"
MINE = "--config-dir elsewhere/mine"
RESULTS = f"results page {{run}} {ELSEWHERE} {MINE}"
INSPECT = f"inspect {{run}} {ELSEWHERE}"
TRAINED, SLOW, PICTURES = ("train", "slow"), ("slow",), ("pictures",)
FULL = (*TRAINED, "full")  # jobs/test_sweep.py and jobs/test_replay.py run these commands with other options

LINES = [
    # --- configs ---
    Line(f"check {MINE} task=mine", "no mistakes"),
    Line("check --physics --all --json task=stand", '"armature_ratio"'),
    Line("check --list", "armature_ratio"),
    Line(f"compose {MINE} task=mine --package env.num_envs", "3"),
    Line("compose --primary evaluate --package seed --resolve --json", "2026"),
    Line("compose --provenance --package env.rewards.base_height", r"configs/task/stand\.yaml"),
    Line("compose --shapes task=stand", "135"),
    Line("explain protocol.seed --primary evaluate --json", '"value": 2026'),
    Line(f"explain env.num_envs task=mine {MINE} --json", r'"value": 3'),
    Line(f"diff task=mine task=stand {MINE}", r"env\.num_envs", status=1),
    Line(f"diff {{run}} {{run}} {ELSEWHERE} --json", r"\{"),
    Line(f"list tasks {MINE}", "mine"),
    Line("list terms reward --json", '"base_height"'),
    Line(f"doctor task=mine {MINE} --all --json", '"armature_ratio"'),
    Line("doctor {robot} --screenshot it.png", "wheel", "it.png", status=1, marks=PICTURES),
    # --- robots and projects ---
    Line("convert {robot} -o robot.xml --variant Physics=PhysX --base fixed --json", '"mapped"', "robot.xml"),
    Line("new mine_too --robot {urdf} --allow-missing --json", '"project": "mine_too"', "mine_too/configs", marks=SLOW),
    Line("completion bash", "complete"),
    # --- a run and its recording ---
    Line(f"list runs {ELSEWHERE} --filter task=stand status=finished --sort started --reverse --json", "{run}"),
    Line(f"verify {{run}} {ELSEWHERE} --json", '"checkpoints"'),
    Line(f"{INSPECT} --id {{run}} --json", '"recording"'),
    Line(f"{INSPECT} --env 0 --iteration 0-1 --term base.pitch --stats --json", '"count": 41'),
    Line(f"{INSPECT} --from 1step --to 41steps --names --summary", r"base\.pitch"),
    Line(f"{INSPECT} --where base.height<0.07 --around 2steps --limit 1", r"base|it holds"),
    Line(f"{INSPECT} --compare {{run}}", "equal"),
    Line("inspect {cut} --repair -o mended.rrd", "", "mended.rrd"),
    Line(f"{INSPECT} --plot curves.svg --export csv -o tables --json", '"plot"', "curves.svg", marks=PICTURES),
    Line(f"{INSPECT} --screenshot s.png --at 20steps --width 64 --height 48", "", "s.png", marks=PICTURES),
    Line(f"{INSPECT} --video v.mp4 --to 0.2s --fps 10 --speed 0.5 --width 64 --height 48", "", "v.mp4", marks=PICTURES),
    Line(f"report {{run}} {ELSEWHERE} --no-pictures -o page.html --json", '"size"', "page.html", marks=SLOW),
    # --- a policy ---
    Line(f"export {{run}} {ELSEWHERE} --checkpoint 0 -o bundle --json", '"largest_difference"', "bundle/runner.py"),
    Line(f"play {{run}} {ELSEWHERE} --checkpoint 0 --json env.num_envs=2", '"episodes": 2', marks=SLOW),
    Line(f"play {{run}} {ELSEWHERE} --script elsewhere/drive.yaml --scene rough --json", r"\{", marks=SLOW),
    Line(f"evaluate {{run}} {ELSEWHERE} {MINE} --checkpoint 0 --json {SHORT}", '"stand/time_to_failure"', marks=SLOW),
    Line(f"evaluate {{run}} {ELSEWHERE} --against reference --reference --stored {SHORT}", "reference", marks=SLOW),
    Line(f"{RESULTS} --into pages --reference --stored --json {SHORT}", '"result": "page"', "pages", marks=SLOW),
    Line(f"zero-agent task=mine {MINE} --steps 5 --json {TINY}", '"figures"', "runs/agents"),
    Line(f"random-agent task=mine {MINE} --steps 5 --json {TINY}", '"figures"', "runs/agents"),
    # --- training ---
    Line(f"train task=mine {MINE} --json {BRIEF}", '"finished"', "runs/stand", marks=TRAINED),
    Line(f"train --multirun seed=1 {BRIEF}", "1 of 1 jobs finished", "runs/sweeps", marks=FULL),
    Line(f"resume {{run}} {ELSEWHERE} {MINE} --json agent.max_iterations=5", '"iterations": 5', marks=TRAINED),
    Line(f"replay {{run}} {ELSEWHERE} --repository {{here}} --iterations 1 --keep --json", '"kept": "', marks=FULL),
]

_INERTIA = '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
_WHEEL = f"""  <link name="{{0}}"><inertial><mass value="0.2"/>{_INERTIA}
    <collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="0.05" length="0.02"/></geometry></collision></link>
  <joint name="{{0}}_wheel" type="continuous"><parent link="base"/><child link="{{0}}"/><origin xyz="0 {{1}} -0.05"/>
    <axis xyz="0 1 0"/></joint>
"""
_URDF = f"""<robot name="cart">
  <link name="base"><inertial><mass value="1"/>{_INERTIA}
    <collision><geometry><mesh filename="missing.stl"/></geometry></collision></link>
{_WHEEL.format("left", 0.1)}{_WHEEL.format("right", -0.1)}</robot>
"""


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    return unpack(tmp_path_factory.mktemp("unpacked"))


@pytest.fixture
def files(unpacked, tmp_path, tmp_path_factory, monkeypatch) -> Iterator[dict[str, str]]:
    here, elsewhere = tmp_path / "here", tmp_path / "here" / "elsewhere"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path_factory.getbasetemp() / "wheelleg-cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # A replay restores the source in this folder.
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    run = Path(shutil.copytree(unpacked, elsewhere / "runs" / "stand" / unpacked.name))
    task = elsewhere / "mine" / "task" / "mine.yaml"
    task.parent.mkdir(parents=True)
    task.write_text("# @package _global_\n# A task of the user.\ndefaults: [stand, _self_]\nenv: {num_envs: 3}\n")
    urdf = elsewhere / "cart.urdf"
    urdf.write_text(_URDF)
    (elsewhere / "drive.yaml").write_text("- {for: 0.2, push: [0.05, 0.0]}\n")
    recording = (run / "recording.rrd").read_bytes()
    (elsewhere / "cut.rrd").write_bytes(recording[: len(recording) * 3 // 4])
    found = {"robot": STOCK_ROBOT, "urdf": urdf, "cut": elsewhere / "cut.rrd", "here": REPOSITORY}
    return {"run": run.name, **{name: str(path) for name, path in found.items()}}


@cache
def documented_fields() -> dict[str, set[str]]:
    """The words in backticks of each row of docs/scripting.md, by command."""
    text = (REPOSITORY / "docs/scripting.md").read_text(encoding="utf-8").partition("## Fields")[2]
    rows = re.findall(r"^\| (`[^|]+`) \| (.+) \|$", text, re.MULTILINE)
    return {name: set(re.findall(r"`(\w+)`", row)) for names, row in rows for name in re.findall(r"`([\w-]+)`", names)}


def test_every_command_with_json_has_documented_fields():
    assert set(documented_fields()) == {name for name in COMMANDS if "--json" in COMMANDS[name].options}


@pytest.mark.parametrize(
    "line", [pytest.param(line, marks=[getattr(pytest.mark, m) for m in line.marks], id=line.words) for line in LINES]
)
def test_a_command_line_works(line: Line, files: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    if line.words.startswith("replay"):
        require_old_code(tmp_path, monkeypatch)
    words = [files.get(word.strip("{}"), word) for word in line.words.split()]
    status, out, err = command(*words)
    # On another kind of CPU, the numbers of a replay can differ from the old run, and the status is 1.
    elsewhere = line.words.startswith("replay") and not of_this_cpu(Path("elsewhere/runs/stand", files["run"]))
    assert status in ({0, 1} if elsewhere else {line.status}), err
    assert re.search(line.output.replace("{run}", files["run"]), out), out
    assert not line.file or Path(line.file).exists(), sorted(Path().iterdir())
    if "--json" in words and words[0] != "compose":
        found = json.loads(out)
        fields = set(found[0] if isinstance(found, list) else found)
        assert fields <= documented_fields()[words[0]]


@pytest.mark.parametrize("name", COMMANDS)
def test_debug_shows_a_traceback(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--debug"]):
        status, out, err = command(name, *words, "--no-such-option")
        assert (status, out) == (2, "")
        assert ("Traceback" in err) == bool(words)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_describes_every_option(name: str):
    status, out, err = command(name, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: wheelleg {name} ")
    for parser_option in COMMANDS[name].options:
        assert parser_option in out


def test_the_script_names_its_commands_and_its_version():
    status, out, _ = command("--help")
    assert status == 0
    assert re.findall(r"^  (\w[\w-]*)  +\S", out, re.MULTILINE) == list(COMMANDS)
    assert re.fullmatch(r"wheelleg \d+\.\d+\.\d+\n", command("--version")[1])
