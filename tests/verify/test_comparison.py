import io
import json
import subprocess
import sys

import onnx
import pytest
import torch
import yaml
from onnx import helper

from verify import synthetic
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import dump_json
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.run_lock import this_process
from wheelleg_exp.verify import compare_runs, environment_differences
from wheelleg_exp.verify.run_differences import decides
from wheelleg_exp.verify.run_parts import Span


@pytest.fixture
def a(copy_run):
    return copy_run("a")


@pytest.fixture
def b(copy_run):
    return copy_run("b")


def compared(a, b, **keywords):
    for run in (a, b):
        if run.manifest().status != "running":
            synthetic.record(run)
    return compare_runs(a, b, **keywords)


def different(a, b, **keywords):
    found = compared(a, b, **keywords)
    assert found.verdict == "different", found.lines()
    document = json.loads(dump_json(found.as_dict()))
    assert (document["verdict"], document["first_divergence"]["part"]) == ("different", found.first_divergence.part)
    assert found.lines()[-1] == f"different: {found.reason}"
    assert any(line.startswith("first difference: ") for line in found.lines())
    return found.first_divergence


def identical(a, b, **keywords):
    found = compared(a, b, **keywords)
    assert (found.verdict, found.first_divergence) == ("identical", None), found.lines()
    return found


def set_scalar(run, iteration, value, name="Loss/value"):
    synthetic.edit_line(run, iteration, lambda line: line["scalars"].update({name: value}))


def set_digest(run, iteration, name):
    synthetic.edit_line(run, iteration, lambda line: line["digests"].update({name: "0" * 16}))


def set_fact(run, section, **facts):
    synthetic.edit(run, lambda data: data[section].update(facts))


def test_two_equal_runs_are_identical_whatever_they_are_called_and_however_long_they_took(a, b):
    synthetic.edit_line(b, 1, lambda line: line["scalars"].update({"Perf/total_fps": 1.0}))
    synthetic.write_recording(b.recording, fps=7.0)
    synthetic.edit(b, lambda data: (data["results"].update(seconds=9.0), data.update(started="2026-01-01T00:00:00Z")))
    found = identical(a, b)
    assert {name: part.state for name, part in found.parts.items()} == dict.fromkeys(found.parts, "equal")
    names = "files settings robot scalars digests checkpoints recording exported results"
    assert set(found.parts) == set(names.split())


def test_differences_of_the_environment_without_effect_are_reported(a, b):
    set_fact(b, "hardware", cpu="another CPU", memory_gib=7)
    set_fact(b, "versions", torch="1.0")
    found, changed = identical(a, b), {("hardware", "cpu"), ("hardware", "memory_gib"), ("versions", "torch")}
    assert {(d.section, d.name) for d in found.environment} == changed
    assert "these differ, but changed no number" in found.lines()


def test_settings_that_change_no_number_are_reported_and_do_not_count(a, b):
    synthetic.edit_params(b, lambda env, agent: (env["sim"].update(nthread=8), agent.update(torch_threads=4)))
    config = (b.hydra / "config.yaml").read_text().replace("torch_threads: 1", "torch_threads: 4")
    (b.hydra / "config.yaml").write_text(config.replace("nthread: 1", "nthread: 8"))
    found = identical(a, b)
    assert [change.key for change in found.settings] == ["env.sim.nthread", "agent.torch_threads"]
    assert any("agent.torch_threads" in line and "changes no number" in line for line in found.lines())


def test_equal_tensors_in_other_bytes_and_equal_files_of_other_commits_are_identical(a, b):
    synthetic.edit_source(b, commit="d" * 40, dirty=False)
    path = b.checkpoint(2)
    torch.save(torch.load(path, weights_only=True), path)  # The archive contains the name of the file.
    assert path.read_bytes() != a.checkpoint(2).read_bytes()
    found = identical(a, b)
    assert "1 equal, in different bytes" in found.parts["checkpoints"].text
    assert found.environment == []


@pytest.mark.parametrize(
    ("change", "kind", "name"),
    [
        (lambda s: s["actor_state_dict"].update(weight=torch.zeros(2, 3)), "shape", "actor_state_dict.weight"),
        (lambda s: s["critic_state_dict"].update(weight=torch.zeros(2).double()), "dtype", "critic_state_dict.weight"),
        (lambda s: s["env"].pop("counter"), "only in A", "env.counter"),
        (lambda s: s["env"].update(more=1), "only in B", "env.more"),
        (lambda s: s["env"].update(counter=73), "values", "env.counter"),
        (lambda s: s["log"].update(returns=[1.0, 2.5]), "values", "log.returns[1]"),
        (lambda s: s["actor_state_dict"]["bias"].__setitem__(1, 0.0), "values", "actor_state_dict.bias"),
    ],
)
def test_every_kind_of_difference_in_a_checkpoint_is_named(a, b, change, kind, name):
    synthetic.edit_state(b, 2, change)
    first = different(a, b)
    assert (first.iteration, first.name, first.details["kind"]) == (2, name, kind)


def test_networks_are_named_before_the_rest_and_random_streams_last(a, b):
    def change(state):
        state["rng"]["torch"].add_(7)
        state["env"]["streams"]["events"].add_(7)
        state["env"].update(counter=0)
        state["critic_state_dict"]["weight"][0] += 1e-3

    synthetic.edit_state(b, 2, change)
    first = different(a, b)
    assert first.name == "critic_state_dict.weight"
    assert first.details["by_part"] == {"critic_state_dict": 1, "env": 1, "env.streams": 1, "rng": 1}
    pair = compared(a, b).checkpoints.pairs[1]
    assert [d.name for d in pair.differences][:2] == ["critic_state_dict.weight", "env.counter"]


@pytest.mark.parametrize(
    ("change", "part", "name"),
    [
        (lambda b: synthetic.edit_line(b, 1, lambda line: line["scalars"].pop("Loss/zero")), "scalars", "Loss/zero"),
        (lambda b: synthetic.edit(b, lambda data: data["results"].update({"Train/mean_reward": 13.0})),
         "results", "Train/mean_reward 14 and 13"),
        (lambda b: synthetic.edit(b, lambda data: data.update(seeds=[4])), "settings", "seed"),
        (lambda b: synthetic.edit_params(b, lambda env, _: env.update(rewards=dict(reversed(env["rewards"].items())))),
         "settings", "env.rewards (order)"),
        (lambda b: synthetic.write_policy(b.exported, weights=b"weightz"), "exported", "policy.pt: weights differ"),
        (lambda b: synthetic.write_policy(b.exported, code=b"other code"), "exported", "policy.pt: code differs"),
        (lambda b: (b.exported / "policy.json").write_text('{"format_version": 2}'),
         "exported", "policy.json: differs in format_version"),
    ],
)  # fmt: skip
def test_one_change_is_found_and_named(a, b, change, part, name):
    change(b)
    first = different(a, b)
    assert (first.part, first.name) == (part, name)


@pytest.mark.parametrize("value", [-0.0, "nan", None, 1e-300, 0.75])
def test_even_the_smallest_change_of_a_scalar_is_found_with_both_values(a, b, value):
    set_scalar(b, 3, value, "Loss/zero")
    first = different(a, b)
    assert (first.iteration, first.part, first.name) == (3, "scalars", "Loss/zero")
    assert (first.a, repr(first.b)) == (0.0, repr(value))


def test_digests_locate_the_iteration_between_checkpoints(a, b):
    for iteration in (3, 4):
        set_digest(b, iteration, "parameters")
    set_digest(b, 4, "environment")
    synthetic.edit_state(b, 4, lambda state: state["actor_state_dict"]["weight"].__setitem__((0, 0), 9.0))
    first = different(a, b)
    assert (first.iteration, first.part, first.name) == (3, "digests", "parameters")
    assert first.details["digests"] == ["parameters"]
    assert {"environment", "streams"} <= set(first.details["equal_digests"])
    checkpoint = first.details["checkpoint"]
    assert (checkpoint["iteration"], checkpoint["name"]) == (4, "actor_state_dict.weight")
    assert checkpoint["details"]["index"] == [0, 0]


def test_digests_of_different_definitions_are_not_compared(a, b):
    for iteration in range(synthetic.ITERATIONS):
        synthetic.edit_line(b, iteration, lambda line: line.update(digest_format=99, digests={"parameters": "0"}))
    assert identical(a, b).parts["digests"].state == "not compared"
    for iteration in synthetic.CHECKPOINTS:
        b.checkpoint(iteration).unlink()
    assert "not shown to be equal" in compared(a, b).reason


def test_digests_of_the_first_format_are_compared_except_of_the_environment(a, b):
    for iteration in range(synthetic.ITERATIONS):
        synthetic.edit_line(b, iteration, lambda line: line.update(digest_format=1))
        set_digest(b, iteration, "environment")
    assert "environment" not in compared(a, b).parts["digests"].details["names"]
    set_digest(b, 3, "streams")
    assert compared(a, b).parts["digests"].details["first_difference"] == {"streams": 3}


def test_damage_of_the_compared_iterations_alone_counts():
    names = ("iterations.jsonl", "model_1.pt", "model_2.pt", "recording.rrd")
    assert [Span(2, whole=False, closed=False).covers(name) for name in names] == [True, True, False, False]
    assert all(Span(2, whole=True, closed=False).covers(name) for name in names)


def test_a_missing_checkpoint_is_reported_and_a_damaged_one_is_different(a, b):
    set_fact(b, "hardware", cpu="another CPU")  # Another CPU does not excuse damage.
    whole = b.checkpoint(2).read_bytes()
    b.checkpoint(2).write_bytes(whole[:-100])
    first = different(a, b)
    assert (first.iteration, first.part) == (2, "checkpoints")
    assert [word for word in ("model_2.pt", "cannot be read") if word not in first.name] == []
    (b.path / "model_2.pt").unlink()
    found = identical(a, b)
    assert found.checkpoints.only_a == [2]
    assert "1 only in A" in found.parts["checkpoints"].text


def test_recordings_are_compared_by_entity_if_their_options_are_equal(a, b):
    synthetic.write_recording(b.recording, height=0.07 + 1e-12)
    assert different(a, b).part == "recording"
    assert compared(a, b).parts["recording"].details["differing"] == ["base/height"]
    b.recording.write_bytes(b"no recording")
    assert different(a, b).part == "recording"
    synthetic.write_recording(b.recording, height=1.0)
    config = yaml.safe_load((b.hydra / "config.yaml").read_text())
    config["recording"]["interval"] = 5
    (b.hydra / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    assert identical(a, b).parts["recording"].state == "not compared"
    config["recording"]["enabled"] = False
    (b.hydra / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    b.recording.unlink()
    assert identical(a, b).parts["recording"].text == "only A has a recording"


def scripted(*layers: torch.nn.Module) -> bytes:
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(torch.nn.Sequential(*layers)), buffer)
    return buffer.getvalue()


def test_torchscript_policies_differ_by_their_code_and_not_by_their_wrapping(a, b):
    synthetic.write_policy(b.exported, places=b"other places")
    assert "weights and code equal, other bytes" in identical(a, b).parts["exported"].text
    torch.manual_seed(0)
    layer, elu = torch.nn.Linear(2, 2), torch.nn.ELU()
    for other in (torch.nn.SELU(), torch.nn.ELU(1.5)):  # The value 1.5 is a constant of the code.
        for run, activation in ((a, elu), (b, other)):
            (run.exported / "policy.pt").write_bytes(scripted(layer, activation))
        assert different(a, b).name == "policy.pt: code differs"


def write_onnx(run, weight=0.5, producer="one", operator="Add", place="/a"):
    weights = [helper.make_tensor("w", onnx.TensorProto.FLOAT, [1], [weight])]
    value = helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    node = helper.make_node(operator, ["x", "w"], ["y"], doc_string=f"made at {place}")
    node.metadata_props.add(key="stack_trace", value=place)
    graph = helper.make_graph([node], "g", [value], [value], weights, doc_string=place)
    onnx.save(helper.make_model(graph, producer_name=producer), run.exported / "policy.onnx")


def test_an_onnx_policy_differs_by_weights_and_graph_and_not_by_who_wrote_it_and_where(a, b):
    write_onnx(a)
    write_onnx(b, producer="two", place="/b")
    assert "policy.onnx: weights and code equal, other bytes" in identical(a, b).parts["exported"].text
    write_onnx(b, weight=0.75)
    assert "policy.onnx: weights differ" in different(a, b).name
    write_onnx(b, operator="Mul")
    assert different(a, b).name == "policy.onnx: code differs"


def test_a_different_setting_is_named_before_a_different_number(a, b):
    synthetic.edit_params(b, lambda env, agent: env["rewards"]["alive"].update(weight=1))  # 1 is the same as 1.0.
    identical(a, b)
    synthetic.edit_params(b, lambda env, agent: agent["algorithm"].update(gamma=0.9))
    assert "the numbers are equal nonetheless" in compared(a, b).reason
    assert different(a, b).name == "agent.algorithm.gamma"
    synthetic.edit_params(b, lambda env, agent: agent["algorithm"].update(gamma=0.99))
    synthetic.edit_params(b, lambda env, agent: env["rewards"]["alive"].update(weight=2.0))
    set_scalar(b, 1, 0.5)
    first = different(a, b)
    assert (first.iteration, first.part, first.name) == (None, "settings", "env.rewards.alive.weight")
    assert (first.a, first.b, first.details["numbers"]["iteration"]) == (1.0, 2.0, 1)


def test_another_robot_is_reported_and_another_mujoco_notation_is_not(a, b):
    identity = json.loads((b.asset / "asset.json").read_text())
    (b.asset / "asset.json").write_text(json.dumps({**identity, "model_sha256": "f" * 64}))
    assert different(a, b).name == "compiled model"
    set_fact(b, "versions", **{"mujoco-core": "99"})
    identical(a, b)
    (b.asset / "robot.xml").write_text("<mujoco><worldbody/></mujoco>")
    assert different(a, b).name == "robot.xml"


def test_a_resume_that_changed_a_setting_counts_and_a_plain_one_does_not(a, b):
    longer = {"key": "agent.max_iterations", "was": 3, "now": 5}
    facts = {"when": "2026-11-20T10:00:00Z", "iteration": 3, "overrides": ["agent.max_iterations=5"], "exact": True}
    synthetic.edit(b, lambda data: data["resumes"].append({**facts, "changes": [longer]}))
    assert identical(a, b).environment == []
    other = {"key": "agent.algorithm.gamma", "was": 0.9, "now": 0.99}
    synthetic.edit(b, lambda data: data["resumes"].append({**facts, "changes": [longer, other]}))
    first = different(a, b)
    assert (first.name, first.b) == ("resumed with other settings", [[3, {"agent.algorithm.gamma": 0.99}]])


def test_a_shorter_run_is_different_and_its_common_part_is_compared(a, b):
    synthetic.shorten(b, 3)
    first = different(a, b)
    assert (first.iteration, first.part, first.name) == (3, "length", "B stops")
    assert compared(a, b).reason == "B stops after iteration 2 (finished); the 3 common iterations are equal to the bit"
    assert different(b, a).name == "A stops"
    found = identical(a, b, common=True)
    assert (found.iterations, [pair.iteration for pair in found.checkpoints.pairs]) == (3, [0, 2])
    assert found.parts["recording"].state == "not compared"
    set_scalar(b, 1, 0.5)
    assert different(a, b).iteration == 1
    assert compared(a, b).reason.endswith("the 3 common iterations differ")


def test_a_number_of_iterations_limits_the_comparison(a, b):
    set_scalar(b, 3, 0.5)
    synthetic.edit_state(b, 4, lambda state: state["env"].update(counter=0))
    assert (identical(a, b, iterations=3).iterations, different(a, b, iterations=4).iteration) == (3, 3)


def test_a_crashed_or_running_run_is_compared_up_to_its_last_iteration(a, b):
    synthetic.crash(b)
    b.recording.write_bytes(b.recording.read_bytes()[:-40])  # A crash cuts the recording off.
    assert identical(a, b).parts["recording"].text == "a run did not end by itself"
    synthetic.shorten(b, 3)
    assert "B stops after iteration 2 (crashed)" in compared(a, b).reason
    synthetic.edit(b, lambda data: data.update(process=this_process()))
    assert "as far as they were compared" in identical(a, b).reason


def test_a_log_with_a_gap_is_never_identical(a, b):
    lines = b.iterations.read_text().splitlines()
    for wrong in ([*lines, lines[0]], [*lines[:2], *lines[3:]], [*lines, lines[-1]]):
        b.iterations.write_text("\n".join(wrong) + "\n")
        assert "B: iterations.jsonl is damaged: line" in compared(a, b).reason
    synthetic.crash(b)  # The manifest of a crashed run has no digest of the log.
    assert "B: iterations.jsonl is damaged: line" in compared(a, b).reason


def test_nothing_to_compare_is_an_error_for_people(a, b):
    with pytest.raises(RunDirectoryError, match="the two runs are the same run"):
        compared(a, a)
    synthetic.crash(b)
    b.iterations.unlink()
    with pytest.raises(RunDirectoryError, match=r"there is no iterations.jsonl"):
        compared(a, b)


def rounded(run, by=1e-6):
    """Change the numbers of a run by a relative amount that grows."""
    for iteration in range(synthetic.ITERATIONS):
        set_digest(run, iteration, "parameters")
        set_scalar(run, iteration, 0.25 / (1 + iteration) * (1 + by * 10**iteration))
    for iteration in synthetic.CHECKPOINTS:
        synthetic.edit_state(run, iteration, lambda state: state["actor_state_dict"]["weight"].mul_(1 + by))


@pytest.fixture
def apart(a, b):
    """Two runs with other numbers in the last digits, as from different CPUs."""
    for run in (a, b):
        for iteration in synthetic.CHECKPOINTS:
            synthetic.edit_state(run, iteration, lambda state: state["actor_state_dict"].pop("bias"))
    rounded(b)
    set_fact(b, "hardware", cpu="another CPU")
    return a, b


def test_rounding_on_another_cpu_is_within_tolerance_and_its_size_is_reported(apart):
    found = compared(*apart)
    assert found.verdict == "within tolerance"
    assert [word for word in ("another CPU", "iteration 0") if word not in found.reason] == []
    assert found.first_divergence.iteration == 0
    assert max(excess.off for excess in found.tolerance.start) == pytest.approx(1e-6, rel=0.1)
    assert json.loads(dump_json(found.as_dict()))["tolerance"]["within"] is True


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda run: run.checkpoint(2).write_bytes(run.checkpoint(2).read_bytes()[:-100]), ""),
        (lambda run: rounded(run, by=0.01), "further apart than rounding allows"),
        (lambda run: synthetic.edit_state(run, 0, lambda s: s["actor_state_dict"]["weight"].mul_(1.01)), "further"),
        (lambda run: synthetic.edit_params(run, lambda env, _: env["rewards"]["alive"].update(weight=1.001)),
         "settings differ"),
    ],
    ids=["damage", "more than rounding", "parameters", "setting"],
)  # fmt: skip
def test_another_cpu_excuses_only_rounding(apart, change, reason):
    a, b = apart
    change(b)
    assert compared(a, b).reason.startswith(reason)
    assert different(a, b).iteration in (0, None)


def test_the_same_rounding_on_the_same_machine_is_different(apart):
    a, b = apart
    set_fact(b, "hardware", cpu=a.manifest().data["hardware"]["cpu"])
    assert "nothing in the environment allows it" in compared(a, b).reason
    set_fact(b, "hardware", memory_gib=3)
    set_fact(b, "threads", physics=2)
    assert different(a, b).iteration == 0


def test_a_run_that_was_resumed_elsewhere_was_made_on_both_machines(apart):
    a, b = apart
    here, there = (run.manifest().data["hardware"] for run in (a, b))
    set_fact(b, "hardware", cpu=here["cpu"])
    entry = {"when": "2026-11-20T10:00:00Z", "iteration": 3, "overrides": [], "before": {"hardware": there}}
    synthetic.edit(b, lambda data: data["resumes"].append(entry))
    found = compared(a, b)
    assert found.verdict == "within tolerance"
    (difference,) = [d for d in found.environment if d.name == "cpu"]
    assert (difference.a, difference.b) == (here["cpu"], ["another CPU", here["cpu"]])


def test_different_code_is_never_within_tolerance_and_reported_if_it_changes_no_number(a, b, request):
    changed = "the code differs (/home/me/pet: changed terms.py)"
    synthetic.edit_source(b, tree="b" * 40, contents={"terms.py": [None, f"100644 {'2' * 40}"]})
    found = identical(a, b)
    assert found.reason == f"equal to the bit in 5 iterations, although {changed}"
    assert any(line.strip().startswith("code.tree") for line in found.lines())
    assert "  /home/me/pet: changed terms.py" in found.lines()
    assert found.as_dict()["environment"]["code"][0]["note"] == "/home/me/pet: changed terms.py"
    first = different(*request.getfixturevalue("apart"))
    assert (first.iteration, first.part) == (0, "digests")
    found = compared(a, b)
    assert found.reason.endswith(f"; {changed}, which another CPU cannot excuse")
    assert found.tolerance is None


def test_code_that_was_not_recorded_is_not_treated_as_equal(a, b, request):
    for run in (a, b):
        synthetic.edit_source(run, status="patch_too_large", tree=None, patch_sha256=None, patch=None)
    assert identical(a, b).reason.endswith("although the code was not recorded")
    assert different(*request.getfixturevalue("apart")).iteration == 0


HARMLESS = ["agent.max_iterations", "agent.save_interval", "agent.max_non_finite", "agent.torch_threads"]
HARMLESS += ["agent.logger", "env.sim.nthread", "env.sim.nconmax", "recording", "recording.interval"]
HARMLESS += ["env.robot.joint_sets.legs", "env.robot.wheel_radius"]


@pytest.mark.parametrize("key", [*HARMLESS, "env.sim.graph_step", "agent.run_name", "env.sim", "run.root"])
def test_which_settings_change_no_number(key):
    assert decides(tuple(key.split("."))) == (key not in HARMLESS)


MACHINE = {"section": "hardware", "name": "cpu", "was": "x", "now": "y"}
SOURCE = {"section": "source", "name": "tree (1)", "was": "a" * 40, "now": "b" * 40}


@pytest.mark.parametrize(
    ("why", "differences", "verdict"),
    [
        (["hardware cpu was x and is y"], [MACHINE], "within tolerance"),
        (["source tree (1) was a and is b"], [SOURCE], "different"),
        (["source tree (1) was a and is b", "hardware cpu was x and is y"], [SOURCE, MACHINE], "different"),
        (["the log after loading are not what was saved", "hardware cpu was x and is y"], [MACHINE], "different"),
        (["iteration 3 is not what it was before the stop: environment differ"], [], "different"),
        ([], [], "different"),
    ],
)
def test_only_a_resume_that_was_inexact_for_the_machine_alone_allows_a_tolerance(apart, why, differences, verdict):
    a, b = apart
    entry = {"when": "2026-11-20T10:00:00Z", "iteration": 3, "exact": False, "why": why, "differences": differences}
    synthetic.edit(b, lambda data: data["resumes"].append(entry))
    found = compared(a, b)
    assert (found.verdict, "B was resumed from iteration 3" in found.reason) == (verdict, verdict == "different")


KERNELS = ("Linux-6.1-x86_64-with-glibc2.36", "Linux-6.9-x86_64-with-glibc2.36", "Linux-6.1-x86_64-with-glibc2.41")
STRICT, FREE = {"environment_variables": {"MKL_CBWR": "AVX2,STRICT"}}, {"environment_variables": {}}
INDEPENDENT, DEPENDENT = {"independent": True}, {"independent": False}


@pytest.mark.parametrize(
    ("section", "a", "b", "also", "allowed"),
    [
        ("hardware", {"cpu": "x"}, {"cpu": "y"}, {}, True),
        ("hardware", {"cpu_flags": ["avx2"]}, {"cpu_flags": ["avx2", "avx512f"]}, {}, True),
        ("hardware", {"cores": 2}, {"cores": 4}, {}, False),
        ("hardware", {"platform": KERNELS[0]}, {"platform": KERNELS[1]}, {}, False),
        ("hardware", {"platform": KERNELS[0]}, {"platform": KERNELS[2]}, {}, True),
        ("versions", {"torch": "2.1"}, {"torch": "2.2"}, {}, True),
        ("versions", {"mujoco": "4.0"}, {"mujoco": "4.1"}, {}, True),
        ("versions", {"mujoco-core": "4.0.0"}, {"mujoco-core": "4.0.1"}, {}, True),
        ("versions", {"rsl-rl-lib": "5.5"}, {"rsl-rl-lib": "5.6"}, {}, False),
        ("threads", {"physics": 1}, {"physics": 2}, {}, False),
        ("threads", {"torch": 1}, {"torch": 2}, STRICT, False),
        ("threads", {"torch": 1}, {"torch": 2}, FREE, True),
        ("threads", {"torch": 1, **INDEPENDENT}, {"torch": 2, **INDEPENDENT}, {}, False),
        ("threads", {"torch": 1, **DEPENDENT}, {"torch": 2, **DEPENDENT}, {}, True),
        ("environment_variables", {"MKL_CBWR": "AVX2"}, {"MKL_CBWR": "COMPATIBLE"}, {}, True),
        ("environment_variables", {"OMP_WAIT_POLICY": "PASSIVE"}, {}, {}, False),
    ],
)
def test_what_allows_other_numbers(section, a, b, also, allowed):
    (found,) = environment_differences(*([ProcessFacts(**{section: facts, **also})] for facts in (a, b)))
    assert (found.allows is not None) == allowed


def test_the_engine_of_an_old_run_has_the_version_of_the_metapackage():
    old, new = {"mujoco": "4.0.0"}, {"mujoco-core": "4.0.1"}
    for was in (old, {**old, "mujoco-core": "4.0.0"}):
        (found,) = environment_differences([ProcessFacts(versions=was)], [ProcessFacts(versions=new)])
        assert (found.name, found.a, found.b, found.allows) == ("mujoco-core", "4.0.0", "4.0.1", "another mujoco-core")
    same = {"mujoco-core": "4.0.0"}
    assert environment_differences([ProcessFacts(versions=old)], [ProcessFacts(versions=same)]) == []


def test_more_packages_are_read_from_the_environment_file(a, b):
    b.environment.write_text("numpy==2.0\npyyaml==6.1\nextra==1\n")
    # A section that only one side has is not compared.
    assert environment_differences([ProcessFacts(versions={"torch": "1"})], [ProcessFacts(hardware={"cpu": "x"})]) == []
    found = identical(a, b)
    assert [(d.name, d.a, d.b) for d in found.environment] == [("extra", None, "1"), ("pyyaml", "6.0", "6.1")]


def test_nothing_heavy_is_imported_before_a_checkpoint_must_be_opened():
    code = "import sys, wheelleg_exp.verify, wheelleg_exp.cli.verify\n"
    code += "print({'torch', 'mujoco', 'rerun', 'pyarrow', 'omegaconf'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
