"""``wheelleg evaluate RUN``: what it keeps below the run, and that it can be verified."""

import csv
import json

import pytest
import torch

from jobs.small import refused, succeed, wheelleg
from wheelleg_exp.jobs.evaluate_policy import evaluation_settings
from wheelleg_exp.rl import checkpoint

pytestmark = pytest.mark.train

SHORT = ("protocol.stand.episodes=3", "protocol.stand.horizon_s=1.5", "protocol.stand.survival_s=[0.5]")


def test_an_evaluation_is_stored_recorded_and_verified(run):
    noise = "{_target_:wheelleg_exp.mdp.noise.UniformNoise,n_min:0.0,n_max:0.0}"
    policy = "env.observations.policy"
    noisy = [f"{policy}.enable_corruption=true", f"+{policy}.terms.projected_gravity.noise={noise}"]
    printed = succeed("evaluate", run.path, *SHORT, *noisy, "--json")
    assert f"note: the policy observes the noise of its training ({policy}.enable_corruption=false" in printed.err
    said = json.loads(printed.out)
    (folder,) = run.evaluation.iterdir()
    stored = json.loads((folder / "evaluation.json").read_text())
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    mean = sum(float(row["time_to_failure_s"]) for row in rows) / 3
    assert stored["metrics"]["stand/time_to_failure"]["value"] == pytest.approx(mean)
    assert stored["metrics"] == said["metrics"]
    assert [row["ended_by"] for row in rows].count("") == 3 - sum(row["survived"] == "0" for row in rows)
    entry = run.manifest().data["additions"][-1]
    assert (entry["kind"], entry["results"]["scenarios_sha256"]) == ("evaluation", stored["scenarios_sha256"])
    succeed("verify", run.path)
    (folder / "evaluation.json").write_text(json.dumps({**stored, "seed": 1}))
    found = wheelleg("verify", run.path)
    assert (found.status, "evaluation.json" in found.out) == (1, True)


REFUSED = {("protocol=stnd",): ["stand"], ("env.robot.asset=other.usd",): ["env.robot.asset"]}
REFUSED[("env.num_envs=4", "agent.device=cuda")] = ["protocol.stand.episodes", "env.sim.device"]  # all keys at once


@pytest.mark.parametrize(("overrides", "words"), REFUSED.items())
def test_a_wrong_protocol_robot_or_unread_override_is_refused(run, overrides, words):
    said = refused("evaluate", run.path, *overrides)
    assert [word for word in words if word not in said] == []


UNREAD = ["env.rewards.alive.weight=9", "~env.rewards.alive", "env.num_envs=4", "env.episode_length_s=9.0"]
UNREAD += ["env.events.push_robot.velocity_range.x=[-1.0,1.0]", "env.terminations.time_out=null", "agent.device=cuda"]
# In the task's files, other keys refer to these keys.
UNREAD += ["env.robot.physics_dt=0.002", "env.robot.standing_height=0.1", "env.robot.action_scales.legs=0.3"]


@pytest.mark.parametrize("override", UNREAD)
def test_an_override_that_no_evaluation_reads_is_refused_by_name(run, override):
    said = refused("evaluate", run.path, *SHORT, "env.decimation=3", override)
    key = override.lstrip("~").partition("=")[0]
    assert f"{key}: this command ignores the key (override {override}); expected" in said
    assert "env.decimation" not in said
    assert not run.evaluation.exists()


@pytest.mark.parametrize(
    "override",
    [
        "env.sim.dt=0.002",
        "env.rewards.base_height.target_height=0.08",
        "+agent.clip_actions=1.0",
        "env.decimation=2",  # The override repeats the run's own value.
        "protocol.ground=own env.scene.terrain.restitution=0.1",
    ],
)
def test_what_an_evaluation_reads_can_be_changed(run, override):
    repeats = override == "env.decimation=2"
    assert (evaluation_settings(run, override.split()) == evaluation_settings(run, [])) is repeats


@pytest.mark.parametrize("command", ["evaluate", "play", "export"])
def test_a_policy_with_nan_is_an_error_of_its_checkpoint(run, command):
    path = run.latest_checkpoint()
    state = checkpoint.load(path)
    name, weights = next(iter(state["actor_state_dict"].items()))
    weights.view(-1)[3] = torch.nan
    path.write_bytes(checkpoint.serialize(state))
    said = refused(command, run.path)
    assert [word for word in (path.name, f"actor.{name} are NaN or inf") if word not in said] == []
    assert not run.evaluation.exists()
