"""The recipes of the docs, run as they stand: their files are written, and their commands find no mistake."""

import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from promises.golden import STOCK_ROBOT
from promises.parsers import parser_of
from promises.runs import unpack

from wheelleg_exp.cli.configs import compose as printing
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import Composed, compose

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "recipes.md").read_text(encoding="utf-8")
FILE = re.compile(r"`([\w./]+\.(?:yaml|py|toml))`[^`]*?:\n```(?:yaml|python|toml)\n(.*?)```", re.DOTALL)
SHELL = re.compile(r"```bash\n(.*?)```", re.DOTALL)
SIMULATING = {"train", "zero-agent", "random-agent"}  # of these the config is checked, and no more
OWN_OPTIONS = {"--steps": 2, "-m": 1}
READING = {"check", "compose", "convert", "diff", "doctor", "explain", "inspect", "list", "verify"}
LACKING = {"--play", "--against"}  # The stored run has no play, and no robot wrote a log.
# The words of the skills that a user replaces; `BASE` and the like become the stored run.
PLACES = {"path/to/robot.urdf": str(STOCK_ROBOT), "robot=myrobot": "robot=article"}


def commands_of(text: str) -> list[str]:
    return [line for block in SHELL.findall(text) for line in block.splitlines() if line.startswith("wheelleg ")]


COMMANDS = commands_of(TEXT)
SKILLS = {path.stem: commands_of(path.read_text(encoding="utf-8")) for path in sorted(DOCS.glob("skills/*.md"))}
NOTEBOOK = (DOCS / "examples" / "first_policy.ipynb").read_text(encoding="utf-8")
STAND = compose(["task=stand"]).config["env"]


@cache
def composed(*words: str, folder: Path | None = None) -> Composed:
    return compose(words, config_dirs=[folder] if folder else [])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder in which a reader would have written the recipes' files."""
    root = tmp_path_factory.mktemp("recipes")
    for name, text in FILE.findall(TEXT):
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    (root / "my_package" / "__init__.py").touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        own = lambda words, primary, config_dirs: composed(*words, folder=(*config_dirs, None)[0])  # noqa: E731
        patch.setattr(printing, "compose", own)
        yield root


def checkable(line: str) -> list[str] | None:
    """The words of a command, as a check where it would simulate; None where it needs a run or makes files."""
    words = shlex.split(line.split("  #")[0])[1:]
    if words[0] not in SIMULATING:
        return words if words[0] in ("compose", "check", "diff") and "--physics" not in words else None
    kept: list[str] = ["check"]
    rest = iter(words[1:])
    for word in rest:
        if word in OWN_OPTIONS:
            for _ in range(OWN_OPTIONS[word] - 1):
                next(rest)
        elif word.count(",") and re.fullmatch(r"[\w.]+=[-\w.,]+", word):
            kept.append(word.split(",")[0])  # the first of a sweep's values
        else:
            kept.append(word)
    return kept


def test_the_page_has_recipes():
    assert len(COMMANDS) > 20
    assert len(FILE.findall(TEXT)) >= 9


@pytest.mark.parametrize("line", {str(checkable(line)): line for line in COMMANDS if checkable(line)}.values())
def test_a_command_finds_no_mistake(folder, capsys, line):
    words = checkable(line)
    assert words is not None
    status = main(words)
    assert status == (1 if words[0] == "diff" else 0), capsys.readouterr().err


def env(folder: Path, *overrides: str) -> dict[str, Any]:
    own = folder / "my_configs" if overrides[0].startswith("task=") else None
    return composed(*overrides, folder=own).config["env"]


def test_a_term_is_added(folder):
    rewards = env(folder, "+reward@env.rewards=action_acceleration")["rewards"]
    assert list(rewards) == [*STAND["rewards"], "action_acceleration"]
    own = env(folder, "+env.rewards.effort={_target_: wheelleg_exp.mdp.rewards.joint_torques_l2, weight: -0.001}")
    assert list(own["rewards"]) == [*STAND["rewards"], "effort"]
    smooth = env(folder, "task=smooth")["rewards"]
    assert list(smooth) == [*STAND["rewards"], "action_acceleration"]
    assert smooth["action_acceleration"]["weight"] == -0.02


@pytest.mark.parametrize(
    "override",
    ["~env.events.push_robot", "env.events.push_robot=null", "task=unpushed"],
    ids=["dropped", "nulled", "task"],
)
def test_a_term_is_dropped(folder, override):
    assert list(env(folder, override)["events"]) == [name for name in STAND["events"] if name != "push_robot"]


@pytest.mark.parametrize("override", ["action@env.actions=[leg_pos,wheel_rel_pos]", "task=stepping"])
def test_a_term_is_replaced(folder, override):
    assert list(env(folder, override)["actions"]) == ["leg_pos", "wheel_rel_pos"]


def test_terms_are_reordered(folder):
    (command,) = [line for line in COMMANDS if "terms=[last_action" in line]
    front = ["last_action", *(name for name in STAND["observations"]["policy"]["terms"] if name != "last_action")]
    for override in (shlex.split(command)[-1], "task=reordered"):
        found = env(folder, override)["observations"]["policy"]["terms"]
        assert list(found) == front
        assert yaml.safe_dump(found) == yaml.safe_dump(STAND["observations"]["policy"]["terms"])


def test_a_stock_file_is_replaced_on_purpose(folder):
    events = composed(folder=folder / "my_replacements").config["env"]["events"]
    assert events["add_base_mass"]["mass_distribution_params"] == [0.0, 0.1]


def test_a_task_changes_its_agent(folder):
    config = composed("task=patient", folder=folder / "my_configs").config
    assert config["agent"]["max_iterations"] == 300
    assert config["recording"]["enabled"] is False


def test_the_notebook_is_stored_without_outputs_and_its_commands_are_valid(capsys):
    cells = [cell for cell in json.loads(NOTEBOOK)["cells"] if cell["cell_type"] == "code"]
    assert [cell["outputs"] for cell in cells] == [[]] * len(cells)
    text = "".join("".join([*cell["source"], "\n"]) for cell in cells)
    values = dict(re.findall(r'^([A-Za-z]+) = "?([\w.]+)"?$', text, re.MULTILINE), base="latest", changed="latest")
    lines = [line.format(**values) for line in re.findall("^%(wheelleg .+)$", text, re.MULTILINE)]
    for line in lines:
        words = shlex.split(line.replace("robot=first_policy", "robot=article"))
        if words[1] in SIMULATING:
            assert main(checkable(shlex.join(words)) or []) == 0, capsys.readouterr().err
        parser_of(words[1]).parse_intermixed_args(words[2:])
    assert [shlex.split(line)[1] for line in lines].count("train") == 2


@pytest.fixture(scope="module")
def with_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A folder with one finished run; the name of the run."""
    root = tmp_path_factory.mktemp("skills")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("WHEELLEG_CACHE", str(root / "cache"))
        yield unpack(root / "runs").name


def test_each_skill_has_a_use_commands_and_a_judgement():
    assert set(SKILLS) == {"bring_a_robot", "change_a_reward", "compare_policies", "deploy", "why_does_it_fall"}
    for name, lines in SKILLS.items():
        text = (DOCS / "skills" / f"{name}.md").read_text(encoding="utf-8")
        assert re.search(r"\A# .+\n\nUse this when .*?```bash\n.*?\n## Judge the result\n", text, re.DOTALL), name
        assert len(lines) > 3


@pytest.mark.parametrize("line", [line for lines in SKILLS.values() for line in lines])
def test_a_command_of_a_skill_works(with_run, capsys, line):
    """Run what only reads, check the config of what trains, and parse the rest."""
    words = [PLACES.get(word, word) for word in shlex.split(line.split("  #")[0])[1:]]
    words = [with_run if re.fullmatch(r"(BASE|CHANGED)(_\d)?", word) else word for word in words]
    if words[0] in SIMULATING:
        words = checkable(shlex.join(["wheelleg", *words])) or []
    if words[0] not in READING or LACKING & set(words):
        parser_of(words[0]).parse_intermixed_args(words[1:])
        return
    status, printed = main(words), capsys.readouterr()
    finding = {"diff": "task=walk", "doctor": str(STOCK_ROBOT)}  # Two tasks differ; the stock file has faults.
    assert status == (finding.get(words[0]) in words), printed.err
    assert "--json" not in words or json.loads(printed.out) is not None
