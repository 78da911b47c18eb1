import json

import pytest

from verify import synthetic
from wheelleg_exp.jobs.train.resume_training import find_point
from wheelleg_exp.run.iteration_log import read_log


def line(iteration, **more):
    return json.dumps({"iteration": iteration, "digests": {"log": "0"}, "scalars": {"a": 1.0, "Perf/s": 2.0}, **more})


def test_each_line_has_its_end_and_its_values(tmp_path):
    path = tmp_path / "iterations.jsonl"
    whole = [line(0) + "\n", line(1, note="ä") + "\n"]
    path.write_text("".join(whole) + line(2)[:-5], encoding="utf-8")
    log = read_log(path)
    data = path.read_bytes()
    assert [data[: x.end].decode() for x in log.lines] == [whole[0], whole[0] + whole[1]]
    assert [x.content["scalars"]["Perf/s"] for x in log.lines] == [2.0, 2.0]
    assert [x.scalars for x in log.lines] == [{"a": 1.0}] * 2
    assert log.cut_off


@pytest.mark.parametrize("wrong", [True, 1.0, "1", None])
def test_an_iteration_that_is_no_whole_number_ends_what_can_be_read(tmp_path, wrong):
    path = tmp_path / "iterations.jsonl"
    path.write_text(line(0) + "\n" + line(wrong) + "\n" + line(2) + "\n")
    log = read_log(path)
    assert ([x.iteration for x in log.lines], log.problems) == ([0], ["line 2 cannot be read"])


def test_a_checkpoint_that_differs_from_the_log_is_reported(copy_run):
    run = copy_run("one")
    synthetic.edit_state(run, 4, lambda state: state["optimizer_state_dict"]["param_groups"][0].update(lr=2e-3))
    synthetic.edit_state(run, 2, lambda state: state["actor_state_dict"]["weight"].zero_())
    told = {path.name: why for path, why in find_point(run).damaged.items()}
    assert told == {
        "model_4.pt": "optimizer differs from the logged digests of iteration 4",
        "model_2.pt": "parameters differ from the logged digests of iteration 2",
    }
