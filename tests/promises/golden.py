"""Record the current answers of the commands, and check that later code gives equal answers.

    python tests/promises/golden.py record tests/promises/golden.json [SECTION ...]
    python tests/promises/golden.py check tests/promises/golden.json [SECTION ...]

Without SECTION, all sections are recorded or checked. ``check`` prints one line per difference and exits with 1. The
script uses only the command line, so that renamed internal modules do not break the script. It compares content: the
wording of a sentence does not count, and a line of a config file counts by its text instead of its number.
"""

import contextlib
import hashlib
import io
import itertools
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from wheelleg_exp.cli.main import main as wheelleg

REPOSITORY = Path(__file__).resolve().parents[2]
GOLDEN = Path(__file__).with_name("golden.json")
CORPUS_VARIABLE = "WHEELLEG_USD_CORPUS"
STOCK_ROBOT = REPOSITORY / "assets" / "wheelleg" / "wheelleg.usda"
TASKS = ("stand", "walk", "velocity", "terrain")
PROSE = "…"  # This text replaces a sentence, because its wording can change.


def command(*words: str | Path) -> tuple[int, str, str]:
    """Run a command in this process; return its exit status, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = wheelleg([str(word) for word in words])
    return status, out.getvalue(), err.getvalue()


def answer(*words: str | Path, digits: int | None = None) -> dict[str, Any]:
    """Run a command with ``--json``; return its exit status and its answer without wording."""
    status, out, err = command(*words, "--json")
    if not out:
        return {"status": status, "error": names_in(err)}
    return {"status": status, "answer": without_wording(json.loads(out), digits=digits)}


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Change to an empty temporary folder, which also contains the cache of converted robots."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        with mock.patch.dict(os.environ, WHEELLEG_CACHE=str(folder / "cache")), contextlib.chdir(folder):
            yield folder


# Sentences under these keys are part of a promise, so the names and numbers in these sentences are compared.
_NAMING = {"message", "expected", "nearest", "type", "limits", "values", "error"}
_SENTENCES = {"text", "meaning", "help", "what", "why", "reason"}
_EXACT = {"key", "override", "takes", "phases"}
_STABLE_TARGETS = ("mdp.", "sim.actuators.", "sim.sensors.", "sim.terrain.", "isaaclab.")
_LINE = re.compile(r"([\w./-]+\.yaml):(\d+)")


def names_in(sentence: str) -> str:
    """Return the names and numbers of a sentence: quoted words, and words with a digit or one of ``_./@=``."""
    found = set()
    for word in in_repository(sentence).split():
        bare = word.strip("'\"`,;:()[]{}.?…")
        if bare and re.search(r"[\d_@=]|\w[./]\w|^'.+'\W*$", word):
            found.add(bare)
    return " ".join(sorted(found))


def in_repository(text: str) -> str:
    """Replace absolute paths of the repository and of the current folder; replace a line's number by its text."""
    text = text.replace(f"{REPOSITORY}/", "").replace(f"{Path.cwd()}/", "here/")
    return _LINE.sub(lambda match: f"{match[1]}:<{line_of(match[1], int(match[2]))}>", text)


def line_of(file: str, number: int) -> str:
    """Return a line of a YAML file without its comment and without blanks, '' for a missing line."""
    for path in (REPOSITORY / file, Path.cwd() / file.removeprefix("here/")):
        if path.is_file():
            lines = path.read_text(encoding="utf-8").splitlines()
            text = re.sub(r"(^|\s)#.*", "", lines[number - 1]) if number <= len(lines) else ""
            text = re.sub(r"^(\s*\w+:) [a-z]+ [a-z]+ .*", r"\1", text)  # This value is a sentence.
            return re.sub(r"\s", "", text)
    return str(number)


def without_wording(value: Any, key: str = "", digits: int | None = None) -> Any:
    """Return a JSON value in which sentences are reduced and numbers are rounded to significant digits."""
    if isinstance(value, dict):
        if isinstance(line := value.get("line"), int):
            value = value | {"line": line_of(in_repository(value["file"]), line)}
        return {name: without_wording(item, name, digits) for name, item in value.items()}
    if isinstance(value, list):
        items = [without_wording(item, key, digits) for item in value]
        return without_internal_meanings(items) if key == "meaning" else items
    if isinstance(value, float) and digits is not None:
        return float(f"{value:.{digits}g}")
    if not isinstance(value, str):
        return value
    text = in_repository(value)
    if key == "where" and text.startswith("wheelleg_exp.") and not text[13:].startswith(_STABLE_TARGETS):
        return "wheelleg_exp"  # The documentation of an internal class can change.
    if key in _EXACT or (key == "where" and text.startswith("override ")):
        return text
    if " " not in text and key not in _SENTENCES:
        return text
    return names_in(value) if key in _NAMING else PROSE


def without_internal_meanings(meanings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Remove the documentation of internal classes, which ``explain`` omits if a config file has the same text."""
    public = [meaning for meaning in meanings if meaning["where"] != "wheelleg_exp"]
    return public or meanings[:1]


def mjcf(only: str | None = None, every: int = 1) -> dict[str, Any]:
    """Convert the stock robot and, if the corpus exists, its robots: sha256 of MJCF and of the mesh files.

    With ``every``, this section and the next four contain only each ``every``-th entry of their long lists.
    """
    found = {}
    with scratch() as folder:
        if only in (None, "stock"):
            found["stock"] = _converted(STOCK_ROBOT, folder / "stock")
            found["stock, fixed"] = _converted(STOCK_ROBOT, folder / "fixed", "--base", "fixed")
        corpus = os.environ.get(CORPUS_VARIABLE)
        if corpus and only in (None, "corpus"):
            for path in sorted(Path(corpus).glob("expected/*.json"))[::every]:
                expected = json.loads(path.read_text(encoding="utf-8"))
                words = expected.get("args", [])
                found[f"corpus/{path.stem}"] = _converted(Path(corpus, expected["asset"]), folder / path.stem, *words)
    return found


def _converted(robot: Path, folder: Path, *words: str) -> dict[str, Any]:
    folder.mkdir()
    status, out, _ = command("convert", robot, "-o", folder / "robot.xml", *words, "--json")
    report = json.loads(out) if out else {}
    counts = {name: len(items) for name, items in sorted(report.items()) if isinstance(items, list)}
    files = {
        str(path.relative_to(folder)): _digest_of_file(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }
    main = {name: files.pop(name, None) for name in ("robot.xml", "robot_scene.xml")}
    return {"status": status, **main, "meshes": [len(files), _sha256(json.dumps(files).encode())], "report": counts}


def _digest_of_file(path: Path) -> str:
    content = path.read_bytes()
    if path.suffix == ".xml":
        text = re.sub(r"<!--.*?-->", "", content.decode(), flags=re.DOTALL)
        content = "\n".join(line.rstrip() for line in text.splitlines() if line.strip()).encode()
    return _sha256(content)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


# Besides the four tasks, these compositions are stored as their differences from the task 'stand'.
_VARIANTS = [
    *(["task=stand", f"robot={name}"] for name in ("explicit", "late", "motor", "physical")),
    *(["task=stand", f"scene={name}"] for name in ("rough", "stairs")),
    *(["task=stand", f"agent={name}"] for name in ("ppo_mirror_loss", "ppo_mirrored", "ppo_rnd", "ppo_symmetry")),
    *(["task=stand", f"agent={name}"] for name in ("distillation", "ppo_wide")),
    ["task=stand", "sim=fine"],
    ["task=walk", "robot=physical"],
    ["task=terrain", "robot=motor"],
    ["task=stand", "env.rewards.base_height.weight=-30", "~env.events.push_robot", "+reward@env.rewards=joint_power"],
]
_PRIMARIES = [["--primary", name] for name in ("evaluate", "play", "pipeline")]
_MOUNTS = {
    "command": "env.commands",
    "action": "env.actions",
    "observation": "env.observations.policy.terms",
    "event": "env.events",
    "reward": "env.rewards",
    "termination": "env.terminations",
    "curriculum": "env.curriculum",
    "sensor": "env.scene.sensors",
    "recorder": "env.recorders",
}


def compose(every: int = 1) -> dict[str, Any]:
    with scratch() as folder:
        stand = _leaves("task=stand")
        found: dict[str, Any] = {"task=stand": stand}
        for words in [*([f"task={task}"] for task in TASKS[1:]), *_VARIANTS][::every]:
            found[" ".join(words)] = _changes(stand, _leaves(*words))
        for words in _PRIMARIES:
            found[" ".join(words)] = _leaves(*words)
        for group, package in list(_MOUNTS.items())[::every]:
            found[f"all of {group}"] = _changes(stand, _all_terms(folder, group, package))
        for task in TASKS[::every]:
            found[f"shapes of {task}"] = answer("compose", "--shapes", f"task={task}")
        for kind in ("tasks", "terms", "groups", "options", "pipelines"):
            found[f"list {kind}"] = answer("list", kind)
    return found


def _leaves(*words: str) -> dict[str, Any]:
    status, out, err = command("compose", "--provenance", *words, "--json")
    if status:
        return {"status": status, "error": names_in(err)}
    return {path: _leaf(path, node) for path, node in json.loads(out).items()}


def _changes(base: dict[str, Any], leaves: dict[str, Any]) -> dict[str, Any]:
    """Return the leaves that differ from the base, the names of absent ones, and a digest of the order of all."""
    changed = {key: value for key, value in leaves.items() if base.get(key) != value}
    return {**changed, "(absent)": sorted(set(base) - set(leaves)), "(order)": _sha256("\n".join(leaves).encode())[:16]}


def _leaf(path: str, node: dict[str, Any]) -> list[Any]:
    value = PROSE if path.startswith("check.silence") else node["value"]
    where = in_repository(node["where"])
    hidden = [[other["value"], in_repository(other["where"])] for other in node["shadowed"]]
    return [value, where, *(item for item in hidden if item != [value, where])]


def _all_terms(folder: Path, group: str, package: str) -> dict[str, Any]:
    _, out, _ = command("list", "options", "--json")
    names = [(row["group"] + "/" + row["option"]).partition("/")[2] for row in json.loads(out)
             if row["group"].partition("/")[0] == group]  # fmt: skip
    task = folder / "mine" / "task" / f"all_{group}.yaml"
    task.parent.mkdir(parents=True, exist_ok=True)
    head = "# @package _global_\ndefaults:\n  - stand\n"
    task.write_text(f"{head}  - /{group}@{package}: [{', '.join(sorted(names))}]\n  - _self_\ntask: {{name: mine}}\n")
    return _leaves("--config-dir", str(folder / "mine"), f"task=all_{group}")


_EXPLAINED = [
    *("seed", "init_from", "init_from_what", "robot", "scene", "sim", "agent", "task", "reward"),
    *("run.root", "run.name"),
    *("env.num_envs", "env.decimation", "env.episode_length_s", "env.sim", "env.sim.dt", "env.sim.engine"),
    *("env.sim.solver", "env.sim.nthread", "env.robot.asset", "env.robot.init_state.pos", "env.scene.terrain"),
    *("env.robot.actuators.legs.stiffness", "env.robot.actuators.wheels.effort_limit", "env.scene.sensors"),
    *("env.commands", "env.commands.base_velocity.ranges.lin_vel_x", "env.actions", "env.actions.leg_pos.scale"),
    *("env.observations.policy.history_length", "env.observations.policy.terms.base_ang_vel.scale"),
    *("env.events.push_robot.interval_range_s", "env.events.physics_material.mode", "env.rewards"),
    *("env.rewards.base_height.weight", "env.rewards.base_height.target_height", "env.terminations.time_out.time_out"),
    *("env.curriculum.lin_vel_z_weight.weight", "agent.max_iterations", "agent.algorithm.gamma", "agent.matmul"),
    *("agent.device", "agent.logger", "agent.actor.hidden_dims", "agent.clip_actions", "recording.interval"),
    *("recording.enabled", "check.silence.armature_ratio"),
]


def explain(every: int = 1) -> dict[str, Any]:
    with scratch():
        found = {key: answer("explain", key) for key in _EXPLAINED[::every]}
        for task in TASKS[1::every]:
            for key in ("env.num_envs", "env.commands.base_velocity.ranges.lin_vel_x", "env.scene.terrain"):
                found[f"{key} task={task}"] = answer("explain", key, f"task={task}")
        changed = "env.rewards.base_height.weight"
        found[f"{changed} changed"] = answer("explain", changed, f"{changed}=-30", "robot=physical")
        for key in ("env.rewards.base_heigt.weight", "env.sim.dtt", "robt"):
            found[key] = answer("explain", key)
    return found


# Mistakes that users make in overrides.
_WRONG_WORDS = [
    *([word] for word in ("env.num_envs=0", "env.num_envs=many")),
    ["env.num_envs", "=", "4"],
    *([word] for word in ("env.num_envs:4", "env.sim.solver=Newton", "env.rewards.base_heigt.weight=2")),
    *([word] for word in ("env.rewards.base_height.wieght=2", "env.rewards.base_height.weight=heavy")),
    *([word] for word in ("task=stnad", "robot=physicl", "+reward@env.rewards=joint_powr")),
    ["env.rewards.alive._target_=wheelleg_exp.mdp.rewards.is_alife"],
    ["env.robot.actuators.wheels.joint_names_expr=[.*04$]"],
    ["env.terminations.base_contact.sensor_cfg.body_names=[base_lnk]"],
    ["env.observations.policy.terms.velocity_commands.command_name=drive"],
    *([word] for word in ("agent.actor.activation=relo", "agent.actor.distribution_cfg.class_name=Gaussian")),
    *([word] for word in ("~env.events.push_robt", "env.num_envs=${sed}")),
    ["env.num_envs=0", "agent.max_iterations=-1", "env.decimation=2.5"],
]
# Mistakes that users make in a file of a task.
_WRONG_TASKS = {
    "wrong_agent": "defaults:\n  - stand\n  - /agent: ppo\n  - _self_\n",
    "wrong_package": "defaults:\n  - stand\n  - /reward@env.rewards: [joint_powr]\n  - _self_\n",
    "wrong_weight": "defaults: [stand, _self_]\nenv:\n  rewards:\n    base_height:\n      weight: heavy\n",
    "wrong_key": "defaults: [stand, _self_]\nenv:\n  rewards:\n    alive:\n      wieght: 2.0\n",
    "wrong_yaml": "defaults: [stand, _self_]\nenv: {rewards: {\n",
    "wrong_term": "defaults: [stand, _self_]\nenv:\n  rewards:\n    mine: {_target_: mine.nothing, weight: 1.0}\n",
}
_DOUBTFUL = [
    ["env.actions.wheel_vel.scale=500.0"],
    ["env.rewards.alive.weight=0.0001"],
    ["env.rewards.base_height.target_height=0.5"],
    ["env.robot.init_state.pos=[0.0,0.0,0.02]"],
    ["env.robot.actuators.wheels.effort_limit=0.001"],
    ["env.sim.dt=0.05"],
]


def check(every: int = 1) -> dict[str, Any]:
    """Check the stock configs, their numbers, mistakes in overrides and files, and implausible numbers."""
    with scratch() as folder:
        found: dict[str, Any] = {}
        for task in TASKS[::every]:
            found[f"task={task}"] = answer("check", "--physics", f"task={task}", digits=5)
        for words in [*_VARIANTS, *_DOUBTFUL][::every]:
            found[" ".join(words)] = _findings(*words)
        found["--list"] = answer("check", "--list")
        found["without --physics"] = answer("check", "task=stand")
        for words in _WRONG_WORDS[::every]:
            found[" ".join(words)] = _mistakes(*words)
        (folder / "mine" / "task").mkdir(parents=True)
        for name, text in list(_WRONG_TASKS.items())[::every]:
            file = folder / "mine" / "task" / f"{name}.yaml"
            file.write_text(f"# @package _global_\n# Mine.\n{text}")
            found[name] = _mistakes("--config-dir", str(folder / "mine"), f"task={name}")
            file.unlink()  # Delete the broken file, because every later composition would report its mistake.
    return found


def _findings(*words: str) -> dict[str, Any]:
    """Return the mistakes and findings of ``check --physics``, and of silenced findings the rules and keys."""
    found = answer("check", "--physics", *words, digits=5)
    if report := found.get("answer"):
        silenced = [f"{item['rule']} {item['key']}" for item in report["silenced"]]
        found["answer"] = {"mistakes": report["mistakes"], "findings": report["findings"], "silenced": silenced}
    return found


def _mistakes(*words: str) -> dict[str, Any]:
    """Return the mistakes as JSON, and the names and numbers that the message for people contains."""
    status, _, err = command("check", *words)
    return {**answer("check", *words), "message": [status, names_in(err)]}


# Mistakes in a small MJCF robot: each replaces one text in the file by another.
_ROBOT = """<mujoco model="two_wheels">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base" pos="0 0 0.2">
      <freejoint/>
      <geom name="trunk" type="box" size="0.1 0.08 0.05" mass="2.0"/>
      <body name="left_wheel" pos="0 0.12 -0.1">
        <joint name="left" type="hinge" axis="0 1 0"/>
        <geom name="left_tyre" type="cylinder" size="0.06 0.02" zaxis="0 1 0" mass="0.3"/>
      </body>
      <body name="right_wheel" pos="0 -0.12 -0.1">
        <joint name="right" type="hinge" axis="0 1 0"/>
        <geom name="right_tyre" type="cylinder" size="0.06 0.02" zaxis="0 1 0" mass="0.3"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
_BROKEN_ROBOTS = {
    "sound": ("", ""),
    "no free joint": ("      <freejoint/>\n", ""),
    "a limited wheel": ('name="left" type="hinge"', 'name="left" type="hinge" range="-1 1"'),
    "a wheel that turns about x": ('name="left" type="hinge" axis="0 1 0"', 'name="left" type="hinge" axis="1 0 0"'),
    "a heavy wheel": ('zaxis="0 1 0" mass="0.3"', 'zaxis="0 1 0" mass="300"'),
    "a wheel that is a box": ('type="cylinder" size="0.06 0.02" zaxis="0 1 0"', 'type="box" size="0.06 0.02 0.06"'),
    "unequal wheels": ('name="left_tyre" type="cylinder" size="0.06', 'name="left_tyre" type="cylinder" size="0.05'),
    "a wheel without collider": ('name="left_tyre" type="cylinder"', 'name="left_tyre" contype="0" conaffinity="0" '
                                 'type="cylinder"'),
    "not XML": ("</worldbody>", ""),
}  # fmt: skip
_WEAK = [
    ["env.robot.actuators.wheels.effort_limit=0.001"],
    ["env.robot.actuators.legs.stiffness=0.1"],
    ["env.robot.init_state.pos=[0.0,0.0,0.02]"],
    ["env.robot.init_state.joint_pos={.*01$: 0.2, .*02$: -0.5, .*03$: 0.0}"],
]


def doctor(every: int = 1) -> dict[str, Any]:
    with scratch() as folder:
        found = {"stock USD": answer("doctor", STOCK_ROBOT, digits=5)}
        robots = [["task=stand", f"robot={name}"] for name in ("explicit", "late", "motor", "physical")]
        known = [*([f"task={task}"] for task in TASKS), *robots, *(["task=stand", *words] for words in _WEAK)]
        for words in known[::every]:
            found[" ".join(words)] = answer("doctor", *words, digits=5)
        for name, (old, new) in list(_BROKEN_ROBOTS.items())[::every]:
            assert old in _ROBOT, name
            file = folder / f"{name.replace(' ', '_')}.xml"
            file.write_text(_ROBOT.replace(old, new, 1) if old else _ROBOT)
            found[name] = answer("doctor", file, digits=5)
        found["missing file"] = answer("doctor", folder / "missing.usda")
    return found


SEEDS, THREADS = (1, 2), (1, 2)


def _earlier(task: str) -> list[str]:
    """Return the settings with which the trainings were recorded, where the defaults differ now."""
    agent = "ppo_mirror_loss" if task in ("walk", "velocity") else "ppo"
    words = ["env.sim.cone=pyramidal", "env.sim.impratio=1.0", "env.commands.base_velocity.max_travel_error=0.1"]
    warm = ["agent.warm_start=0", "agent.average_iterations=80"] if task == "walk" else []
    return [f"agent={agent}", *words, *warm]


def training(only: str | None = None) -> dict[str, Any]:
    """Train each task for three iterations of 64 environments: digests of the checkpoint and of the scalars.

    With ``only``, train this task once, with one of the seeds and one of the numbers of threads. Results are stored
    per CPU model, because floats may differ between CPUs.
    """
    trained = {}
    for task in TASKS if only is None else [only]:
        pairs = list(itertools.product(SEEDS, THREADS))
        for seed, threads in pairs if only is None else [pairs[TASKS.index(task)]]:
            trained[f"{task}, seed {seed}, threads {threads}"] = _trained(task, seed, threads)
    return {cpu(): trained}


def short_training(only: str | None = None) -> dict[str, Any]:
    """Train each task for two iterations of six control steps: the scalars, equal within 1e-3 on every CPU.

    Longer trainings of two CPUs diverge, because contacts amplify rounding errors.
    """
    found = {}
    for task in TASKS if only is None else [only]:
        with scratch() as folder:
            words = [f"task={task}", *_earlier(task), "env.num_envs=64", "agent.max_iterations=2"]
            words += ["agent.num_steps_per_env=6"]
            words += ["env.sim.nthread=1", "agent.torch_threads=1", "recording.enabled=false"]
            status, _, err = command("train", *words, f"run.root={folder}/runs")
            assert status == 0, err
            (log,) = folder.glob("runs/*/*/iterations.jsonl")
            found[task] = [
                {key: value for key, value in json.loads(line)["scalars"].items() if not key.startswith("Perf/")}
                for line in log.read_text(encoding="utf-8").splitlines()
            ]
    return found


def cpu() -> str:
    fields = dict.fromkeys(("model name", "cpu family", "model", "stepping"), "")
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        name, _, value = line.partition(":")
        if name.strip() in fields:
            fields[name.strip()] = value.strip()
    return " ".join(fields.values())


def _trained(task: str, seed: int, threads: int) -> dict[str, Any]:
    with scratch() as folder:
        words = [f"task={task}", *_earlier(task), f"seed={seed}", "env.num_envs=64", "agent.max_iterations=3"]
        words += [f"env.sim.nthread={threads}", f"agent.torch_threads={threads}", "recording.enabled=false"]
        status, _, err = command("train", *words, f"run.root={folder}/runs")
        if status:
            return {"status": status, "error": err}
        (run,) = (folder / "runs" / task).iterdir()
        saved = torch.load(run / "model_2.pt", map_location="cpu", weights_only=False)
        lines = [json.loads(line) for line in (run / "iterations.jsonl").read_text().splitlines()]
    learner = {name: saved[name] for name in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict")}
    scalars = [{key: value for key, value in line["scalars"].items() if not key.startswith("Perf/")} for line in lines]
    found: dict[str, Any] = {
        "learner": _sha256(json.dumps(dict(_tensors(learner))).encode())[:32],
        "scalars": _sha256(json.dumps(scalars, sort_keys=True).encode())[:32],
        "mean_reward": [line["scalars"]["Train/mean_reward"] for line in lines],
    }
    # Compare the state of simulation, managers and random streams by content, because its layout can change.
    if seed == threads == 1:
        found["state"] = {name: digest[:12] for name, digest in _tensors(saved["env"]) if _is_state(name)}
    return found


def _is_state(name: str) -> bool:
    # The logs can change, but the indices never change.
    return not name.startswith("/extras/") and not name.endswith("_ids")


def _tensors(node: Any, path: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(node, torch.Tensor):
        content = node.detach().contiguous().cpu().reshape(-1).view(torch.uint8).numpy().tobytes()
        yield path, _sha256(f"{node.dtype} {tuple(node.shape)} ".encode() + content)
    elif isinstance(node, dict):
        for name, item in node.items():
            yield from _tensors(item, f"{path}/{name}")
    elif isinstance(node, list | tuple):
        if node and all(isinstance(item, torch.Tensor) and item.shape == node[0].shape for item in node):
            # A history can be one tensor (N, T, ...), or a list of T tensors (N, ...).
            yield from _tensors(torch.stack(tuple(node), dim=1), f"{path}/(stacked)")
        for index, item in enumerate(node):
            yield from _tensors(item, f"{path}/{index}")


SECTIONS: dict[str, Callable[..., dict[str, Any]]] = {
    "mjcf": mjcf,
    "compose": compose,
    "explain": explain,
    "check": check,
    "doctor": doctor,
    "training": training,
    "short training": short_training,
}


def differences(golden: dict[str, Any], found: dict[str, Any], section: str = "") -> list[str]:
    """Return one line per value that differs; a corpus or CPU without values on one side is not compared."""
    lines = []
    for name in {**golden, **found}:
        optional = section == "training" or (section == "mjcf" and name.startswith("corpus/"))
        if not (optional and name not in found) and not (section == "training" and name not in golden):
            lines += _compare(golden.get(name), found.get(name), f"{section}: {name}")
    return lines


def _compare(old: Any, new: Any, path: str) -> list[str]:
    if path.endswith(" / state") and isinstance(old, dict) and isinstance(new, dict):
        digests = set(new.values())
        return [f"{path}: no tensor equals the old {name}" for name, value in old.items() if value not in digests]
    if path.endswith(" / robot.xml") and isinstance(old, list) and new in old:
        return []  # CPUs round the last digit of four robots differently, so the digests of both CPUs are recorded.
    if isinstance(old, dict) and isinstance(new, dict):
        return [line for key in {**old, **new} for line in _compare(old.get(key), new.get(key), f"{path} / {key}")]
    if path == "compose: list terms / answer":  # The order of the terms is that of their definitions and can change.
        old, new = (
            sorted(terms or [], key=lambda term: (term["group"], term["term"], term["target"])) for terms in (old, new)
        )
    if path.endswith(" / where") and isinstance(new, str) and new.startswith("wheelleg_exp."):
        old, new = (str(name).rpartition(".")[2] for name in (old, new))  # The module of a class can change.
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return [line for index, (a, b) in pairs for line in _compare(a, b, f"{path} / {index}")]
    if isinstance(old, float) and isinstance(new, float) and path.startswith(("check: ", "doctor: ")):
        return [] if math.isclose(old, new, rel_tol=1e-4, abs_tol=1e-9) else [f"{path}: was {old}, is {new}"]
    if isinstance(old, float) and isinstance(new, float) and path.startswith("short training: "):
        absolute = (
            1e-4 if " / 0 / " in path else 1e-3
        )  # The second rollout follows an update, which amplifies rounding.
        return [] if math.isclose(old, new, rel_tol=1e-3, abs_tol=absolute) else [f"{path}: was {old}, is {new}"]
    return [] if old == new else [f"{path}: was {json.dumps(old)[:500]}, is {json.dumps(new)[:500]}"]


def load(file: Path = GOLDEN) -> dict[str, Any]:
    return json.loads(file.read_text(encoding="utf-8"))


def record(file: Path, names: Sequence[str]) -> None:
    """Write sections to the file; other sections, and trainings of other CPUs, stay in the file."""
    sections = load(file) if file.is_file() else {}
    for name in names:
        found = json.loads(json.dumps(SECTIONS[name]()))
        sections[name] = {**sections.get(name, {}), **found} if name in ("training", "mjcf") else found
    blocks = []
    for name in (name for name in SECTIONS if name in sections):  # One line per entry, so that a diff shows the entry.
        lines = [f"  {json.dumps(key)}: {json.dumps(x, ensure_ascii=False)}" for key, x in sections[name].items()]
        blocks.append(f"{json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n}")
    file.write_text("{" + ",\n".join(blocks) + "}\n", encoding="utf-8")


def main(words: Sequence[str]) -> int:
    """Record or check, and return the exit status."""
    if len(words) < 2 or words[0] not in ("record", "check") or set(words[2:]) - set(SECTIONS):
        sys.stderr.write(f"expected record|check FILE [SECTION ...], with sections of {', '.join(SECTIONS)}\n")
        return 2
    file, names = Path(words[1]).resolve(), list(words[2:]) or list(SECTIONS)
    if words[0] == "record":
        record(file, names)
        return 0
    golden, failed = load(file), 0
    for name in names:
        lines = differences(golden[name], json.loads(json.dumps(SECTIONS[name]())), name)
        sys.stdout.write("\n".join(lines or [f"{name}: equal"]) + "\n")
        failed += len(lines)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
