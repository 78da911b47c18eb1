"""Every draw of the environment comes from the stream of its term: no global generator moves, no term moves another."""

import copy
from functools import reduce
from operator import getitem

import pytest
import torch

from env.composed import event, term
from env.test_determinism import FRICTION, RANGES, SHARES
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.determinism import no_global_draws

BASE = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", "body_names": ["base"]}
SPAN = {"x": [-0.1, 0.1], "yaw": [-0.3, 0.3]}
JOINTS = {"position_range": [0.9, 1.1], "velocity_range": [-0.1, 0.1]}
WRENCH = {"force_range": [-0.1, 0.1], "torque_range": [-0.01, 0.01]}
TURN = {"pose_range": {"x": [-0.1, 0.1]}, "velocity_range": SPAN}
OFTEN = {"interval_range_s": [0.02, 0.05], "velocity_range": SPAN}
# The config has one event of each class that draws random numbers.
EVENTS = {
    "material": event("randomize_rigid_body_material", "startup", num_buckets=16, **FRICTION),
    "mass": event("randomize_rigid_body_mass", "startup", mass_distribution_params=[0.8, 1.3], operation="scale"),
    "com": event("randomize_rigid_body_com_cumulative", "reset", com_range={"x": [-0.1, 0.1]}, asset_cfg=BASE),
    "wrench": event("set_permanent_body_wrench", "reset", asset_cfg=BASE, **WRENCH),
    "push": event("push_by_adding_velocity", "interval", **OFTEN),
    "shove": event("set_root_velocity", "interval", is_global_time=True, **OFTEN),
    "place": event("reset_root_state_uniform", "reset", pose_range=SPAN, velocity_range=SPAN),
    "turn": event("reset_root_state_with_random_orientation", "reset", **TURN),
    "scale": event("reset_joints_by_scale", "reset", **JOINTS),
    "offset": event("reset_joints_by_offset", "reset", **JOINTS),
}
COMMANDS = {
    name: term("commands.UniformVelocityCommand", resampling_time_range=[0.02, 0.05], ranges=RANGES, **SHARES)
    for name in ("v", "w")
}
BIAS = {"noise_cfg": term("noise.GaussianNoise"), "bias_noise_cfg": term("noise.UniformNoise", operation="abs")}
OBSERVATIONS = {
    "uniform": term("observations.base_ang_vel", noise=term("noise.UniformNoise")),
    "gaussian": term("observations.projected_gravity", noise=term("noise.GaussianNoise")),
    "bias": term("observations.joint_pos", noise=term("noise.NoiseModelWithAdditiveBias", **BIAS)),
}
TERMINATIONS = {"time_out": term("terminations.time_out", time_out=True)}
DRAWING = [f"events.{name}" for name in EVENTS]
DRAWING += [f"commands.{name}" for name in COMMANDS]
DRAWING += [f"observations.policy.terms.{name}" for name in OBSERVATIONS]


def sections():
    group = {"terms": OBSERVATIONS, "enable_corruption": True}
    parts = {"events": EVENTS, "commands": COMMANDS, "observations": {"policy": group}, "terminations": TERMINATIONS}
    return copy.deepcopy(parts)


def lived(env):
    """Reset and step the environment until every term has drawn random numbers; no episode ends in these steps."""
    for _ in range(2):
        env.reset()
        for _ in range(4):
            env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))
    return env


def streams(env):
    return {path: state.tolist() for path, state in lived(env).streams.state_dict()["generators"].items()}


@pytest.fixture
def make(make_env):
    return lambda parts: make_env(num_envs=4, episode_length_s=60.0, seed=5, **parts)


@pytest.fixture
def reference(make):
    return streams(make(sections()))


def test_no_global_generator_moves_while_an_environment_is_built_reset_and_stepped(make):
    with no_global_draws():
        env = lived(make(sections()))
    new = type(env.streams)(5)
    states = env.streams.state_dict()["generators"].items()
    moved = [path for path, state in states if not torch.equal(state, new.get(path).get_state())]
    missing = [path for path in DRAWING if not any(name.startswith(f"env.{path}") for name in moved)]
    assert not missing, "a term that has not drawn proves nothing"


@pytest.mark.parametrize("removed", DRAWING)
def test_without_one_term_every_other_draws_the_same(make, reference, removed):
    parts = sections()
    *above, name = removed.split(".")
    del reduce(getitem, above, parts)[name]
    left = streams(make(parts))
    assert left == {path: state for path, state in reference.items() if not path.startswith(f"env.{removed}")}
    assert len(left) < len(reference)


def test_the_order_of_terms_changes_no_draw(make, reference):
    parts = sections()
    for section in (parts["events"], parts["commands"], parts["observations"]["policy"]["terms"]):
        for name in reversed(list(section)):
            section[name] = section.pop(name)
    assert streams(make(parts)) == reference


@pytest.mark.parametrize(
    ("draw", "name"),
    [
        (lambda: torch.rand(1), "torch"),
        (lambda: torch.empty(3).uniform_(), "torch"),
        (lambda: __import__("numpy").random.rand(), "numpy"),
        (lambda: __import__("random").random(), "python"),
    ],
)
def test_a_draw_from_a_global_generator_is_named(draw, name):
    with pytest.raises(ConfigError, match=f"global generator of {name};"), no_global_draws():
        draw()


def test_a_global_generator_that_is_not_watched_and_a_stream_may_draw():
    before, stream = torch.get_rng_state(), torch.Generator().manual_seed(0)
    with no_global_draws("numpy", "python"):
        torch.rand(1)
    assert not torch.equal(torch.get_rng_state(), before)
    with no_global_draws():
        first = torch.rand(1, generator=stream)
    assert not torch.equal(torch.rand(1, generator=stream), first)
