import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from patience import thinned

from foreign.trial import VARIABLE, Trial, every_second
from wheelleg_exp.files import read_yaml, write_yaml

from .test_archives import Runs

pytestmark = pytest.mark.train

ENV, AGENT, CONFIG = "params/env.yaml", "params/agent.yaml", ".hydra/config.yaml"
TERM = "env.rewards.base_height"


def in_term(value: Any) -> Callable[[Any], Any]:
    return lambda env: env["rewards"]["base_height"].update(target_height=value)


@pytest.fixture
def read(trial: Trial) -> str:
    path = trial.run.path / "array.npy"
    np.save(path, np.array([Runs(trial.canary)], dtype=object), allow_pickle=True)
    return f"{{_target_: numpy.load, file: '{path}', allow_pickle: true}}"


TEXTS = ["${oc.create:%s}", "${oc.decode:%s}", "${trial:}", "${oc.env:%s}", "a ${oc.env:%s}"]


@pytest.mark.parametrize(("text", "command"), every_second(TEXTS, ["play", "resume", "diff", "compare"]))
def test_a_text_in_the_parameters_is_not_resolved(trial, read, text, command):
    OmegaConf.register_new_resolver("trial", lambda: trial.canary.touch(), replace=True)
    value = text.replace("%s", VARIABLE if "env" in text else read)
    trial.yaml(ENV, in_term(value))
    trial.try_(command, 1 if command == "compare" else 2, f"{TERM}.target_height: the value contains '${{'", ENV)
    OmegaConf.clear_resolver("trial")


def test_keys_are_not_resolved_and_a_report_shows_such_texts_unchanged(trial):
    text = f"${{oc.env:{VARIABLE}}}"
    trial.yaml(ENV, in_term(text))
    trial.try_("report", 0, text)
    trial.yaml(AGENT, lambda agent: agent.update({text: 1}))
    trial.yaml(ENV, in_term(0.1))
    trial.try_("play", 2, "contains '${'", AGENT)


TARGETS = [
    {"_target_": "numpy.load", "file": "/dev/zero"},
    {"_target_": "shutil.copyfile", "src": "/etc/hostname", "dst": "../ran"},
    {"_target_": "torch.load", "f": "x", "weights_only": False},
    {"_target_": "joblib.load", "filename": "x"},
    {"_target_": "os.system", "command": "touch ../ran"},
    {"_target_": "builtins.exec", "object": "open('../ran', 'w')"},
    {"_target_": "wheelleg_exp.mdp.observations.torch.load", "f": "x"},
    {"_target_": "wheelleg_exp.files.write_text", "path": "../ran", "text": ""},
    {"_target_": "wheelleg_exp.config.composing.compose.compose"},
]


@pytest.mark.parametrize(("node", "command"), every_second(TARGETS, ["play", "resume"]))
def test_no_target_outside_the_allowed_packages_is_called(trial, node, command):
    trial.yaml(ENV, in_term(node))
    trial.try_(command, 2, node["_target_"].rpartition(".")[0], f"{TERM}.target_height")


@pytest.mark.parametrize("key", ["_partial_", "_args_", "_recursive_", "_convert_"])
def test_no_special_key_of_hydra_gets_around_that(trial, key):
    node = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", key: True}
    trial.yaml(ENV, lambda env: env["rewards"]["base_height"].update(asset_cfg=node))
    trial.try_("play", 2, f"Hydra's key '{key}' is not supported in terms")


@pytest.mark.parametrize(("section", "command"), [("actor", "play"), ("algorithm", "resume")])
@pytest.mark.parametrize("name", ["os:system", "os.system", "rsl_rl.utils.utils:importlib.import_module", "evil:Net"])
def test_no_class_of_an_agent_is_imported_from_elsewhere(trial, name, section, command):
    trial.write("evil.py", f"open({str(trial.canary)!r}, 'w')\nclass Net: pass\n")
    sys.path.insert(0, str(trial.run.path))
    trial.yaml(AGENT, lambda agent: agent[section].update(class_name=name))
    try:
        trial.try_(command, 2, f"agent.{section}.class_name: class '{name}' is outside the allowed packages")
    finally:
        sys.path.remove(str(trial.run.path))


def test_no_function_of_a_symmetry_is_imported_from_elsewhere(trial):
    symmetry = {"use_data_augmentation": True, "data_augmentation_func": "os:system"}
    trial.yaml(AGENT, lambda agent: agent["algorithm"].update(symmetry_cfg=symmetry))
    trial.try_("play", 2, "class 'os:system' is outside the allowed packages")


BROKEN = {
    "a tag": "a: !!python/object/apply:os.system ['touch ../ran']\n",
    "deep brackets": "a: " + "[" * 100_000,
    "deep mappings": "".join(" " * i + "a:\n" for i in range(400)),
    "an alias": "a: &a [x, x]\nb: [*a, *a]\n",
    "itself": "&a {a: *a}\n",
    "a long number": "num_envs: " + "1" * 5000 + "\n",
    "a thirteenth month": "num_envs: 2020-13-45\n",
    "a list": "- 1\n",
    "bytes": b"\xff\xfe\x00",
    "a zero": "a: 'b\0'\n",
    "much": "a: '" + "x" * (1 << 22) + "'\n",
}  # fmt: skip


@pytest.mark.parametrize(("content", "told"), every_second(BROKEN.values(), [("verify", 1), ("report", 0)]))
def test_parameters_that_are_not_plain_yaml_are_refused(trial, content, told):
    trial.write(ENV, content)
    trial.try_each(("play", "resume", "diff"), 2, ENV)
    trial.try_(*told, "env.yaml")
    trial.try_("list", 0)


def test_sections_of_another_type_are_refused(trial):
    whole = read_yaml(trial.healthy.path / ENV)
    sections = ("sim", "scene", "robot", "rewards", "observations", "events", "num_envs", "actions")
    for section, value in every_second(sections, (None, 5, "x", [], [1], {}, {"a": 1}, True, 1e999)):
        trial.yaml(ENV, lambda env, change={section: value}: env.update({**whole, **change}))
        trial.try_("play", (0, 2))


ASKING = ("${oc.env:TRIAL_VARIABLE}", "${oc.env:TRIAL_VARIABLE,x}", "${oc.decode:${oc.env:TRIAL_VARIABLE}}")


@pytest.mark.parametrize("text", thinned(ASKING, 2))
def test_no_variable_of_this_machine_gets_into_anything(trial, text):
    trial.yaml(CONFIG, lambda c: (c["run"].update(name=text, note=text), c["recording"].update(interval=text)))
    missing = f"requests the environment variable {VARIABLE}, which was not stored with the run"
    told = [CONFIG, missing] if ",x" not in text else []
    trial.try_("resume", 2, *told)
    trial.try_each(("diff", "compare"), (0, 1))
    trial.try_("report", 0)  # The command report also verifies the run.


def test_a_resolver_of_this_process_is_not_called(trial):
    OmegaConf.register_new_resolver("trial", lambda: trial.canary.touch(), replace=True)
    trial.yaml(CONFIG, lambda config: config["run"].update(name="${trial:}"))
    trial.try_("resume", 2, CONFIG, "trial")
    trial.try_each(("diff", "compare", "report"), (0, 1))
    OmegaConf.clear_resolver("trial")


def test_interpolations_that_double_each_other_are_refused(trial, monkeypatch):
    monkeypatch.setattr("wheelleg_exp.run.run_config._MAX_STEPS", 1000)  # A smaller limit shortens the test.
    bomb = {"x0": "0123456789", **{f"x{i}": f"${{run.x{i - 1}}}" * 2 for i in range(1, 16)}, "name": "${run.x15}"}
    trial.yaml(CONFIG, lambda config: config["run"].update(bomb))
    trial.try_("resume", 2, CONFIG, "more than 1000 interpolations")
    trial.try_each(("diff", "report"), (0, 1))


@pytest.mark.parametrize("text", ["${" * 1500, "${oc.decode:" + "[" * 5000 + "}", "${a" + "${b}" * 40_000 + "}"])
def test_endless_interpolations_are_refused(trial, text):
    trial.yaml(CONFIG, lambda config: config["run"].update(name=text))
    trial.try_("resume", 2, CONFIG)
    trial.try_("verify", (0, 1))


@pytest.mark.parametrize("content", thinned([*list(BROKEN.values())[:6:2], "a list: [", "- 1\n"], 2))
def test_a_damaged_config_is_refused(trial, content):
    trial.write(CONFIG, content)
    trial.try_("resume", 2, CONFIG)
    trial.try_each(("report", "inspect"), (0, 1))  # The command report also verifies the run.


def test_a_config_without_its_sections_is_refused(trial):
    for key in ("recording", "run", "seed", "task"):
        kept = (trial.run.path / CONFIG).read_text()
        trial.yaml(CONFIG, lambda config, key=key: config.pop(key))
        trial.try_("resume", 2, key)
        trial.write(CONFIG, kept)


WORDS = [
    "hydra.searchpath=[pkg://trial_module.configs]",
    "hydra.searchpath=[file:///dev]",
    "run.name=${oc.env:TRIAL_VARIABLE}",
    "task=../../here/precious",
    "+reward@env.rewards=../../../here/precious",
    "[" * 5000,
    "x" * 100_000,
]


@pytest.mark.parametrize("word", WORDS, ids=lambda word: word[:30])
def test_no_recorded_word_leads_hydra_anywhere(trial, word, monkeypatch):
    trial.outside()
    module = trial.root / "modules" / "trial_module"
    module.mkdir(parents=True)
    (module / "__init__.py").write_text(f"open({str(trial.canary)!r}, 'w')\n")
    (module / "configs").mkdir()
    monkeypatch.syspath_prepend(module.parent)
    trial.write(".hydra/overrides.yaml", json.dumps([word]))
    trial.try_("report", 0, "override")
    trial.try_("diff", (0, 1))
    assert "trial_module" not in sys.modules


@pytest.mark.parametrize("text", ["{a: 1}", "seed=3", "3"])
def test_overrides_that_are_not_a_list_are_refused(trial, text):
    trial.write(".hydra/overrides.yaml", text)
    trial.try_("resume", 2, "is not a list", ".hydra/overrides.yaml")


def test_no_recorded_task_or_folder_leads_a_report_to_files_of_the_user(trial):
    secret = trial.root / "here" / "task"
    secret.mkdir()
    (secret / "private.yaml").write_text("# @package _global_\ndefaults: [/task/stand, _self_]\nprecious: {deep: 1}\n")
    trial.leaks.append("precious")
    sources = [{"path": str(secret.parent), "schema": "file", "provider": "config-dir"}]
    for choice in ("private", "../here/task/private", f"{secret}/private", "stand hydra.searchpath=[pkg://os]"):
        runtime = {"choices": {"task": choice}, "config_sources": sources}
        write_yaml(trial.run.hydra / "hydra.yaml", {"hydra": {"runtime": runtime}})
        trial.try_("report", 0, "The task cannot be composed here")


PARTS = {
    "include": '<include file="../../../../here/precious.yaml"/>',
    "mesh": '<asset><mesh name="m" file="/etc/hostname"/></asset>',
    "folder": '<compiler meshdir="../../../../here"/>',
    "model": '<asset><model name="m" file="a.xml"/></asset>',
    "plugin": '<extension><plugin plugin="evil"/></extension>',
    "copies": '<worldbody><replicate count="1000000000"><geom size="1"/></replicate></worldbody>',
    "a picture": '<asset><texture name="t" type="2d" builtin="flat" width="90000" height="90000"/></asset>',
    "memory": '<size memory="900T"/>',
    "no xml": "<<<",
}


@pytest.mark.parametrize(("part", "command"), every_second(PARTS.values(), ["play", "resume"]))
def test_a_robot_reads_no_other_files_and_takes_no_memory(trial, part, command):
    trial.outside()
    path = trial.run.asset / "robot.xml"
    trial.write("asset/robot.xml", path.read_text().replace("<worldbody>", f"{part}<worldbody>", 1))
    trial.try_(command, 2, "asset/robot.xml")


CONTENTS = ['{"model_sha256": 1, "sources": []}', "{}", "[" * 5000, "[]", "\xff"]


@pytest.mark.parametrize(("name", "content"), every_second(["asset/asset.json", "asset/report.json"], CONTENTS))
def test_damaged_reports_of_the_robot_are_reported(trial, name, content):
    trial.write(name, content.encode("latin-1"))
    trial.try_("resume", 2, name)
    trial.try_("play", (0, 2))
    trial.try_("diff", (0, 1, 2))
    trial.try_("report", 0)  # The command report also verifies the run.


def test_a_package_in_the_run_is_not_found(trial):
    text = f"open({str(trial.canary)!r}, 'w')\n"
    for name in ("yaml", "onnx", "hydra_plugins", "sitecustomize", "evil"):
        trial.write(f"{name}/__init__.py", text)
    trial.yaml(ENV, in_term({"_target_": "evil.terms.f"}))
    trial.try_("play", 2, "evil.terms.f")
