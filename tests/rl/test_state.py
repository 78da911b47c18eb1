"""Test that a trainer restored from a checkpoint equals the original, for all kinds of rsl_rl state."""

import io

import pytest
import torch
from env.crawler import Crawl, differing

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.network_loading import Initial

from .conftest import saved, without_times

pytestmark = pytest.mark.train

# These values are overwritten before they are read: the last rollout, and results of the last forward pass.
DERIVED = frozenset(
    [
        *(".algorithm.storage", ".algorithm.transition", ".algorithm.intrinsic_rewards", ".rnd.weight", ".grad"),
        *("['distribution']._distribution", "._views['sensordata']", "._views['actuator_force']", "._sim._current"),
        *(".step_errors", ".robot.data.motion_at_start"),  # only used within a control step
        *(".robot._has_new_targets", ".action_manager._is_new"),  # set at the start of a control step
        *("._has_worked", ".form", "._part_forms", "._is_declared"),  # used in messages
        *(
            "._ppo.update._rows",
            "._ppo.update._advantages",
            "._ppo.update._rate",
            "._ppo.update._sums",
        ),  # set in each update
        *("._norms", "._largest_norm", "._counts", ".data._history"),
        *("._data", "._readings", "._pressures", "._normals"),
        *(".robot.data._cache", "._shows_outputs"),
    ]
)
NORMALISED = ["agent.actor.obs_normalization=true", "agent.critic.obs_normalization=true"]
RND = [
    "+agent.obs_groups.rnd_state=[policy]",
    "+agent.algorithm.rnd_cfg={weight: 0.5, num_outputs: 4, predictor_hidden_dims: [8], target_hidden_dims: [8], "
    "state_normalization: true, reward_normalization: true, "
    "weight_schedule: {mode: linear, initial_step: 0, final_step: 100, final_value: 0.1}}",
]
RNN = ("{0}.class_name=RNNModel", "+{0}.rnn_type=lstm", "+{0}.rnn_hidden_dim=8", "+{0}.rnn_num_layers=1")
RECURRENT = [word.format(f"agent.{role}") for role in ("actor", "critic") for word in RNN]
KINDS = {"plain": [], "normalised": NORMALISED, "rnd": RND, "recurrent": RECURRENT}
KINDS |= {name: [f"agent={name}"] for name in ("ppo_symmetry", "ppo_mirrored", "ppo_mirror_loss")}
KINDS["averaged"] = ["agent.average_iterations=2"]
KINDS["warm"] = ["+agent.warm_critic=2", "agent.average_iterations=2"]
KINDS["initial"] = [*NORMALISED, "+agent.initial_kl={weight: 1.0, except_while: velocity_commands}"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_restored_trainer_has_the_same_values_everywhere(make_trainer, kind, tmp_path):
    initial = None
    if kind == "initial":
        initial = Initial(make_trainer(*NORMALISED, seed=7).state_dict(), ("actor",), {})
    trainer = make_trainer(*KINDS[kind], initial=initial)
    list(trainer.learn(until=2))
    path = saved(trainer.state_dict(), tmp_path)
    other = make_trainer(*KINDS[kind], seed=5, initial=initial)
    other.load_state_dict(checkpoint.load(path))
    assert differing(Crawl(trainer, DERIVED), Crawl(other, DERIVED)) == []
    after = []
    for each in (trainer, other):
        torch.set_rng_state(checkpoint.load(path)["rng"]["torch"])
        (done,) = each.learn(until=3)
        after.append((without_times(done), checkpoint.serialize(each.state_dict())))
    assert after[0] == after[1]
    assert differing(Crawl(trainer), Crawl(other)) == []


SPOILS = [
    ("rnd", lambda state: state["unsaved"]["rnd"].update(update_counter=0)),
    ("rnd", lambda state: state["unsaved"]["rnd"]["average"].add_(1.0)),
    ("recurrent", lambda state: state["unsaved"]["hidden"]["actor"][0].add_(0.1)),
    ("plain", lambda state: state["optimizer_state_dict"]["state"][0]["exp_avg"].add_(1e-3)),
    ("plain", lambda state: state["log"]["return"].add_(1.0)),
    ("plain", lambda state: state["env"]["managers"]["rewards"]["_sums"].add_(1.0)),
    ("plain", lambda state: state["rng"].update(torch=torch.Generator().manual_seed(1).get_state())),
]


@pytest.mark.parametrize("kind", ["rnd", "recurrent", "plain"])
def test_each_part_matters(make_trainer, kind):
    trainer = make_trainer(*KINDS[kind])
    list(trainer.learn(until=1))
    state_bytes = checkpoint.serialize(trainer.state_dict())
    ends = []
    for change in (lambda _: None, *(spoil for of, spoil in SPOILS if of == kind)):
        state = torch.load(io.BytesIO(state_bytes), weights_only=True)
        change(state)
        trainer = make_trainer(*KINDS[kind])
        trainer.load_state_dict(state)
        before = digests.of_state(trainer.state_dict())
        (done,) = trainer.learn(until=2)
        ends.append((before, without_times(done)))
    assert [end for end in ends[1:] if end[0] == ends[0][0] or end[1] == ends[0][1]] == []


def test_a_checkpoint_of_the_first_version_can_be_played_and_not_resumed(make_trainer, tmp_path):
    trainer = make_trainer()
    path = saved({**trainer.state_dict(), "format_version": 1}, tmp_path)
    with pytest.raises(RunDirectoryError, match="can be played"):
        trainer.load_state_dict(checkpoint.load(path))


def test_the_state_of_other_networks_does_not_fit(make_trainer):
    trainer, wider = make_trainer(), make_trainer("agent.actor.hidden_dims=[32,8]")
    with pytest.raises(RunDirectoryError, match="does not fit"):
        wider.load_state_dict(trainer.state_dict())
