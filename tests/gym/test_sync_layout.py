"""The vector environment, compared with Gymnasium's ``SyncVectorEnv`` over the rows of a batch."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.gym import ENV_ID

N, STEPS = 4, 90
# The manual batch computes one more observation where a row is reset, so observations must not draw random numbers or
# contain integrals. 1 s is 60 control steps.
WITHOUT_INTEGRAL = [
    f"~env.{key}.travel_error" for key in ("observations.policy.terms", "observations.critic.terms", "rewards")
]
OVERRIDES = ["env.sim.nthread=1", "env.episode_length_s=1.0", *WITHOUT_INTEGRAL]


class Batch:
    """A batch of environments that are stepped and reset together."""

    def __init__(self, next_step: bool) -> None:
        self.env = build_env(compose(["task=stand", *OVERRIDES, f"env.num_envs={N}"]).config)
        self.env.autoreset = "disabled"
        self.next_step = next_step
        self.done = np.zeros(N, bool)
        self.mask = np.ones(N, bool)

    def begin(self, seed: int) -> None:
        self.observed, self.log = self.env.reset(seed=seed)[0], None

    def round(self, actions: np.ndarray) -> None:
        """Advance all environments, then reset those that ended in this round, or in the last round."""
        left = self.done
        done = self.step(actions)
        self.done = done & ~left if self.next_step else done
        self.reset(left if self.next_step else done)

    def step(self, actions: np.ndarray) -> np.ndarray:
        self.last, *self.stepped, extras = self.env.step(torch.from_numpy(actions))
        self.non_finite = dict(extras.get("non_finite", {}).get("keys", {}))
        return (self.stepped[1] | self.stepped[2]).numpy()

    def reset(self, mask: np.ndarray) -> None:
        self.log = None
        if mask.any():
            self.observed, extras = self.env.reset(env_ids=torch.from_numpy(mask).nonzero().squeeze(1))
            self.log = {key: float(value) for key, value in extras["log"].items()}


class Row(gymnasium.Env):
    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, batch: Batch, row: int, spaces: gymnasium.vector.VectorEnv) -> None:
        self.batch, self.row = batch, row
        self.observation_space, self.action_space = spaces.single_observation_space, spaces.single_action_space

    def reset(self, *, seed=None, options=None):
        log = self.batch.log
        return self._of(self.batch.observed), {} if log is None else {"log": dict(log)}

    def step(self, action):
        reward, terminated, truncated = (part[self.row] for part in self.batch.stepped)
        keys = self.batch.non_finite
        info = {"non_finite": keys[self.row]} if self.row in keys else {}
        return self._of(self.batch.last), float(reward), bool(terminated), bool(truncated), info

    def _of(self, observations):
        return {group: value[self.row].numpy().copy() for group, value in observations.items()}


def require_same(found, expected, path="", *, loosely=()):
    """Require equal types, shapes, and values of two trees, except values at the paths ``loosely``."""
    assert type(found) is type(expected), path
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), path
        for key in expected:
            require_same(found[key], expected[key], f"{path}/{key}", loosely=loosely)
    elif isinstance(expected, (tuple, list)):
        assert len(found) == len(expected), path
        for i, (a, b) in enumerate(zip(found, expected, strict=True)):
            require_same(a, b, f"{path}/{i}", loosely=loosely)
    elif isinstance(expected, np.ndarray):
        assert (found.shape, found.dtype) == (expected.shape, expected.dtype), path
        if expected.dtype == object:
            require_same(found.tolist(), expected.tolist(), path, loosely=loosely)
        elif not any(part in path for part in loosely):
            np.testing.assert_array_equal(found, expected, path)
    else:
        assert found == expected, path


def actions_of(round_):
    return np.random.default_rng(round_).uniform(-1.0, 1.0, (N, 6)).astype(np.float32)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_everything_has_the_layout_of_gymnasium(mode):
    ours = gymnasium.make_vec(ENV_ID, num_envs=N, overrides=OVERRIDES, autoreset_mode=mode)
    batch = Batch(next_step=mode is AutoresetMode.NEXT_STEP)
    theirs = SyncVectorEnv([lambda row=row: Row(batch, row, ours) for row in range(N)], autoreset_mode=mode)
    batch.begin(3)
    require_same(ours.reset(seed=3), theirs.reset(seed=3))
    # In the manual batch, the managers also measure commands in the last step of an episode, and in next_step they
    # count the step that only resets. Separate tests check the managers' logs.
    loosely = ("/log/",) if mode is AutoresetMode.NEXT_STEP else ("Metrics/",)
    seen, ends = set(), 0
    for k in range(STEPS):
        actions = actions_of(k)
        if k == 20:
            actions[1, 2] = np.nan
        if mode is AutoresetMode.DISABLED:
            batch.step(actions)
        else:
            batch.round(actions)
        found, expected = ours.step(actions), theirs.step(actions)
        require_same(found, expected, f"step {k}", loosely=loosely)
        done = found[2] | found[3]
        seen, ends = seen | found[4].keys(), ends + done.sum()
        if mode is AutoresetMode.DISABLED and done.any():
            batch.reset(done)
            options = {"reset_mask": done}
            require_same(ours.reset(options=options), theirs.reset(options={**options}), f"reset {k}")
            assert options["reset_mask"] is done
    assert ends > N
    wanted = {"final_obs", "final_info", "log"} if mode is AutoresetMode.SAME_STEP else {"non_finite", "log"}
    wanted = {"non_finite"} if mode is AutoresetMode.DISABLED else wanted
    assert seen == wanted | {f"_{key}" for key in wanted}


def test_a_step_that_only_resets_is_not_counted():
    """With ``next_step`` the managers log the rewards that the environment returned."""
    env = gymnasium.make_vec(ENV_ID, num_envs=N, overrides=OVERRIDES, autoreset_mode="next_step")
    env.reset(seed=0)
    returns, before, checked = np.zeros(N), np.zeros(N, bool), 0
    for k in range(STEPS):
        _, rewards, terminated, truncated, infos = env.step(actions_of(k))
        assert (rewards[before] == 0).all()
        assert not (terminated | truncated)[before].any()
        assert ("log" in infos) == before.any()
        if before.any():
            log = infos["log"]
            mean = sum(values[before][0] for key, values in log.items() if key.startswith("Episode_Reward/"))
            assert mean * 1.0 == pytest.approx(returns[before].mean(), rel=1e-4)  # divided by the longest episode's 1 s
            checked += 1
        returns = np.where(before, 0.0, returns + rewards)
        before = terminated | truncated
    assert checked > 1


def test_a_partial_reset_does_not_change_the_other_environments():
    noisy = [*OVERRIDES, "env.observations.policy.enable_corruption=true"]
    env = gymnasium.make_vec(ENV_ID, num_envs=N, overrides=noisy, autoreset_mode="disabled")
    env.reset(seed=0)
    for k in range(5):
        before, *_ = env.step(actions_of(k))
    mask = np.array([False, True, False, True])
    after, infos = env.reset(options={"reset_mask": mask})
    for group in before:
        np.testing.assert_array_equal(after[group][~mask], before[group][~mask])
        assert (after[group][mask] != before[group][mask]).any(axis=1).all()
    assert (infos["_log"].tolist(), env.unwrapped.env.episode_length_buf.tolist()) == (mask.tolist(), [5, 0, 5, 0])
    gravity = env.step(actions_of(9))[0]["policy"][:, 15:30].reshape(N, 5, 3)
    np.testing.assert_array_equal(gravity[~mask][:, :4], before["policy"][~mask][:, 15:30].reshape(2, 5, 3)[:, 1:])


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        *(([True] * N, TypeError), (np.ones(N, int), TypeError)),
        *((np.ones(N + 1, bool), ValueError), (np.zeros(N, bool), ValueError)),
    ],
)
def test_an_invalid_mask_is_refused_as_by_gymnasium(mask, error):
    for env in (
        gymnasium.make_vec(ENV_ID, num_envs=N, overrides=OVERRIDES, autoreset_mode="disabled"),
        gymnasium.make_vec("CartPole-v1", num_envs=N, vectorization_mode="sync"),
    ):
        env.reset(seed=0)
        with pytest.raises(error, match="reset_mask"):
            env.reset(options={"reset_mask": mask})


def test_without_autoreset_a_seed_for_some_environments_and_a_step_after_the_end_are_refused():
    env = gymnasium.make_vec(ENV_ID, num_envs=2, overrides=["env.episode_length_s=0.05"], autoreset_mode="disabled")
    with pytest.raises(ValueError, match="give a seed only if all environments are reset"):
        env.reset(seed=0, options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros((2, 6), np.float32))
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((2, 6), np.float32))
