"""Make ``assets/policies/NAME.zip`` from a run: ``python docs/make_policies.py NAME RUN [LICENSE]``.

The zip file contains the networks of the run's last checkpoint, the config, the robot, and the evaluations of these
networks. ``LICENSE`` is a text file with the origin and the licence of a foreign robot. To ship evaluations, make the
zip file, evaluate ``stock:NAME``, and make the zip file again from the run directory in ``runs/stock``.

``python docs/make_policies.py check [NAME ...]`` evaluates all policies, or the named ones, and compares their metrics
with the bounds in ``assets/policies/gates.yaml``. The exit status is 1 if a policy violates a bound.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.files import dump_json, read_yaml, sha256, write_bytes, write_text, write_yaml
from wheelleg_exp.jobs.evaluate_policy import evaluate_run
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, judge
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run.file_inventory import MANIFEST_NAME, inventory, record_files
from wheelleg_exp.run.manifest import text_with_digest
from wheelleg_exp.run.run_directory import RunDirectory, checkpoint_iteration
from wheelleg_exp.run.stock_policies import GATES, PREFIX, SUMS, stock_names
from wheelleg_exp.terms.config_sections import read_section

_COPIED = ("params/env.yaml", "params/agent.yaml", ".hydra/config.yaml", ".hydra/overrides.yaml", "environment.txt")
_ROBOT = ("asset/asset.json", "asset/robot.xml", "asset/report.json")
# Facts about folders and processes of the training, which mean nothing on another machine.
_LOCAL = ("working_directory", "process", "environment_variables", "sha256")
_LOCAL_WORDS = ("run.root=", "run.name=", "recording.enabled=")


def slim(name: str, run: RunDirectory, folder: Path, license_file: str | None = None) -> None:
    """Write a small run directory into ``folder``, with everything that a play needs."""
    shutil.copytree(run.asset, folder / "asset", ignore=shutil.ignore_patterns("init_from.pt", "teacher.pt"))
    if license_file is not None:
        shutil.copyfile(license_file, folder / "asset" / "LICENSE")
    for file in (*_COPIED, *_ROBOT):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        write_text(folder / file, _without_folders((run.path / file).read_text()))
    config = read_yaml(folder / ".hydra/config.yaml")
    config["run"].update(root="runs", name=None)
    write_yaml(folder / ".hydra/config.yaml", config)
    write_yaml(folder / ".hydra/overrides.yaml", _words(read_yaml(folder / ".hydra/overrides.yaml")))
    choices = read_yaml(run.path / ".hydra/hydra.yaml")["hydra"]["runtime"]["choices"]
    write_yaml(folder / ".hydra/hydra.yaml", {"hydra": {"runtime": {"choices": choices}}})
    last = run.latest_checkpoint()
    state = checkpoint.load(last)
    networks = {"actor_state_dict": checkpoint.policy_state(state), "critic_state_dict": state["critic_state_dict"]}
    small = {"format_version": 1, "iter": checkpoint_iteration(last), **networks}
    write_bytes(folder / last.name, checkpoint.serialize(small))
    data = {key: value for key, value in run.manifest().data.items() if key not in _LOCAL}
    data.update(command=_words(data["command"]), config_dirs=[], files=inventory(folder), resumes=[], stock=name)
    data["source"] = {key: value for key, value in data["source"].items() if key != "root"}
    digest = sha256(folder / last.name)
    evaluations = [entry for entry in data["additions"] if entry["kind"] == "evaluation"]
    newest = {e["results"]["protocol"]: e for e in evaluations if e["results"]["checkpoint_sha256"] == digest}
    data["additions"] = [_evaluation(run, entry, folder) for entry in newest.values()]
    write_text(folder / MANIFEST_NAME, text_with_digest(json.loads(_without_folders(dump_json(data)))))


def _without_folders(text: str) -> str:
    """Make the paths of runs relative, and remove the comments, which contain variables and files of a machine."""
    text = re.sub(r"(?m)^#.*\n|  # (?:editable )?file:.*$", "", text)
    return re.sub(r"((?:init_from|named)\W{1,4})/[\w./-]*/", r"\1", re.sub(r"/[\w./-]*/runs/", "runs/", text))


def _words(words: list[str]) -> list[str]:
    return [word for word in words if not word.startswith(_LOCAL_WORDS)]


def _evaluation(run: RunDirectory, entry: dict[str, Any], folder: Path) -> dict[str, Any]:
    [name] = (name for name in entry["files"] if name.endswith("evaluation.json"))
    (folder / name).parent.mkdir(parents=True)
    shutil.copyfile(run.path / name, folder / name)
    return {**entry, "command": _words(entry["command"]), "files": record_files(folder, [folder / name])}


def main(name: str, run: str, license_file: str | None = None) -> None:
    """Write the zip file, and the digests of all zip files."""
    target = assets_dir() / "policies" / f"{name}.zip"
    target.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        slim(name, RunDirectory.open(run, "runs"), Path(folder), license_file)
        for path in sorted(path for path in Path(folder).rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())  # with a fixed date
            archive.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    sums = [f"{sha256(path)}  {path.name}\n" for path in sorted(target.parent.glob("*.zip"))]
    write_text(target.with_name(SUMS), "".join(sums))


def check(names: Sequence[str], evaluate: Callable[[str, list[str]], Evaluation]) -> list[str]:
    """Return the bounds in ``gates.yaml`` that the policies ``names`` violate, in words.

    ``evaluate`` evaluates the policy of a name with the given overrides.
    """
    gates = read_yaml(assets_dir() / "policies" / GATES)
    why = []
    for name in names:
        for node in (gates["own"][name], *([] if name in gates["exempt"] else [gates["standing"]])):
            gate = read_section(Gate, node, name)
            found = evaluate(name, [f"protocol={gate.protocol}", *gate.overrides])
            verdict = judge(gate, {metric: figure.value for metric, figure in found.metrics.items()})
            sys.stdout.write(f"{name}, protocol={gate.protocol}: {verdict.values}\n")
            why += [f"{PREFIX}{name}, protocol={gate.protocol}: {text}" for text in verdict.why]
    return why


def _evaluated(name: str, overrides: list[str]) -> Evaluation:
    command = ["wheelleg", "evaluate", PREFIX + name, *overrides]
    return evaluate_run(RunDirectory.open(PREFIX + name, "runs"), None, overrides, command).evaluation


if __name__ == "__main__":
    if sys.argv[1] == "check":
        sys.exit("\n".join(check(sys.argv[2:] or stock_names(), _evaluated)) or 0)
    main(*sys.argv[1:])
