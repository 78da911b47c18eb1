"""Test the messages between the processes that train one policy together."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from jobs.ranks import SIZE, end, start

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.rl import ranks
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.ranks import ALONE, Ranks, joined
from wheelleg_exp.sim.options import read_env

pytestmark = pytest.mark.slow

# Each process prints its received messages; the last line of the first process is an error of the second process.
_TALK = """
import json, os, sys
os.environ["MASTER_PORT"] = str(json.loads(sys.argv[2])[0])
import torch
from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.rl.ranks import Left
from wheelleg_exp.rl.ranks import joined

with joined() as ranks:
    said = [ranks.any(ranks.rank == 1), ranks.any(False)]
    said += [ranks.gather_all({"n": ranks.rank}), ranks.from_first(str(ranks.rank))]
    tree = {"x": torch.full((ranks.rank + 1,), float(ranks.rank)), "name": "r" * ranks.rank}
    said.append([[t["x"].tolist(), t["name"]] for t in ranks.gather(tree)])
    scalars = {"a": 1.0 + ranks.rank, "Perf/total_fps": 10.0, "Perf/learning_time": 2.0 - ranks.rank,
               "Diagnostics/non_finite/env.x": 1.0, **({"b": 5.0} if ranks.rank else {})}
    said.append(ranks.merged(scalars, ["Perf/learning_time"]))
    for kind, evidence in ((ConfigError, {}), (SimulationFailure, {"qpos": torch.ones(2)})):
        try:
            with ranks.agreed():
                if ranks.rank == 1:
                    raise kind("is wrong", key="env.x", **({"evidence": evidence} if evidence else {}))
        except WheellegError as error:
            evidence = bool(getattr(error, "evidence", None))
            said.append([type(error).__name__, error.message, error.key, getattr(error, "saves_state", None), evidence])
    try:
        ranks.require_equal({"the config": "a" * (1 + ranks.rank)})
    except WheellegError as error:
        said.append([type(error).__name__, str(error)])
    print(json.dumps(said), flush=True)
    if ranks.rank == 1:
        os._exit(7)
    try:
        ranks.any(True)
    except Left as error:
        print(json.dumps(error.message), flush=True)
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory) -> list[list]:
    found = end(start([[]], tmp_path_factory.mktemp("ranks"), _TALK))
    assert all(out for _, out, _ in found), found
    return [[json.loads(line) for line in out.splitlines()] for _, out, _ in found]


def test_processes_receive_messages_and_the_first_one_merges_scalars(said):
    for (words, *_), rank in zip(said, range(SIZE), strict=True):
        assert words[:4] == [True, False, [{"n": 0}, {"n": 1}], "0"]
        assert words[4] == ([[[0.0], ""], [[1.0, 1.0], "r"]] if rank == 0 else [])
    # Scalars are means, times are the longest ones, and counts are sums.
    expected = {"a": 1.5, "Perf/total_fps": 20.0, "Perf/learning_time": 2.0, "b": 5.0}
    assert said[0][0][5] == {**expected, "Diagnostics/non_finite/env.x": 2.0}


def test_the_first_rank_reports_the_error_of_another_and_the_remaining_are_silent(said):
    assert said[0][0][6:8] == [
        ["ConfigError", "is wrong [in process 1]", "env.x", None, False],
        ["SimulationFailure", "is wrong [in process 1]", "env.x", None, True],
    ]
    assert [words[0] for words in said[1][0][6:]] == ["FirstRankFailed"] * 3
    assert [words[3] for words in said[1][0][6:8]] == [False, True]


def test_another_config_and_a_process_that_dies_are_detected(said):
    kind, message = said[0][0][8]
    assert kind == "ConfigError"
    assert message.startswith("the config: process 1 has another value than the first process")
    assert said[0][1] == "another process of the training has ended"


def test_a_single_process_sends_nothing_and_other_processes_have_their_own_streams():
    assert Ranks(0, 4).seed(5) == 5
    assert [Ranks(rank, 4).seed(5) for rank in (1, 2)] == [stream_seed(5, "rank/1"), stream_seed(5, "rank/2")]
    assert (ALONE.any(True), ALONE.any(False), ALONE.gather_all([1]), ALONE.from_first(2)) == (True, False, [[1]], 2)
    state = {"x": torch.ones(2)}
    assert ranks.state_of_all_ranks(ALONE, state) == state
    assert ALONE.seed(5) == 5
    with pytest.raises(ConfigError), ALONE.agreed():
        raise ConfigError("is wrong")


def test_each_process_has_its_own_gpu_and_its_share_of_the_cores(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr("wheelleg_exp.rl.ranks.usable_cores", lambda: 8)
    config = compose(["task=stand", "env.sim.nthread=0", "agent.device=cuda"]).config
    env, agent, second = read_env(config["env"]), read_agent(config["agent"]), Ranks(3, 4, 1, 2)
    assert second.env(env) == replace(env, sim=replace(env.sim, nthread=4))
    assert second.agent(agent) == second.agent(replace(agent, device="cuda:0")) == replace(agent, device="cuda:1")
    assert (ALONE.env(env), ALONE.agent(agent)) == (env, agent)
    with pytest.raises(ConfigError, match=r"agent\.device: there are 3 processes on this machine and 2 GPUs"):
        Ranks(2, 3, 2, 3).agent(agent)
    with pytest.raises(ConfigError, match=r"all 4 processes would share 'cuda:1'; expected cuda"):
        second.agent(replace(agent, device="cuda:1"))


def test_variables_that_are_not_torchruns_are_refused(monkeypatch):
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for size, message in (("2", "2 processes, but RANK is not set"), ("many", "WORLD_SIZE: the variable is 'many'")):
        monkeypatch.setenv("WORLD_SIZE", size)
        with pytest.raises(ConfigError, match=message), joined():
            pass


def test_the_parts_of_a_state_are_those_of_each():
    first = {"actor_state_dict": {"w": torch.ones(1)}, **{key: {"of": 0} for key in ranks.OWN_KEYS_OF_A_RANK}}
    state = {**first, "ranks": [{key: {"of": rank} for key in ranks.OWN_KEYS_OF_A_RANK} for rank in (1, 2)]}
    assert ranks.state_of_rank(state, 0) == first
    assert ranks.state_of_rank(state, 2)["env"] == {"of": 2}
    assert ranks.state_of_rank(state, 2)["actor_state_dict"] is first["actor_state_dict"]
