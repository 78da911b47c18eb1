"""The figures of PPO against the episode and the robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, at_least, at_most, rule
from wheelleg_exp.lint.rules_rewards import horizon_steps

_GAMMA = "agent.algorithm.gamma"
_AVERAGE = "agent.average_iterations"
_DUST = 1e-9  # of binary fractions, in 1 - gamma
_FALLS = 5.0  # time constants of the fall that the discount should reach
_EARLY = 0.25  # most of a mean of weights that may be of its beginning


@rule
def ppo_batch(case: Case) -> Iterator[Finding]:
    """A batch that does not divide into its mini-batches.

    rsl_rl cuts the batch of num_envs · num_steps_per_env samples into mini-batches of a whole size and drops the
    rest. Source: rsl_rl, ``storage/rollout_storage.py``.
    """
    batch = int(case.env["num_envs"]) * int(case.agent["num_steps_per_env"])
    parts = int(case.agent["algorithm"].get("num_mini_batches", 1))
    if batch % parts:
        yield Finding(
            "agent.algorithm.num_mini_batches",
            f"{batch} samples in {parts} mini-batches of {batch // parts} leave {batch % parts} unused",
            "a number of environments or steps that the mini-batches divide",
            {"batch": batch, "mini_batches": parts, "unused": batch % parts},
        )


@rule
def discount_horizon(case: Case) -> Iterator[Finding]:
    """A discount that looks further than an episode, or less far than a fall.

    1/(1 - gamma) steps ahead a reward counts 1/e. Beyond the episode's end the agent learns of what never comes;
    short of some five time constants of the fall it does not see what its actions lead to. Source: the discounted
    return.
    """
    steps = horizon_steps(case)
    seconds = steps * case.step_dt
    balance = case.facts.balance
    fall = _FALLS / balance.pole if balance is not None else 0.0
    if steps > case.episode_steps * (1 + _DUST):
        yield Finding(
            _GAMMA,
            f"the discount looks {seconds:.3g} s ahead, and an episode lasts {case.episode_s:g} s",
            figures={"horizon_s": seconds if math.isfinite(seconds) else -1.0, "episode_s": case.episode_s},
            **_advice(case, fall, "most", at_least(1.0 / case.episode_steps, 3)),
        )
    if balance is not None and seconds < fall * (1 - _DUST):
        yield Finding(
            _GAMMA,
            f"the discount looks {seconds:.3g} s ahead, {seconds * balance.pole:.2g} time constants of the fall",
            figures={"horizon_s": seconds, "time_constant_s": 1 / balance.pole},
            **_advice(case, fall, "least", at_most(case.step_dt / fall, 3)),
        )


def _advice(case: Case, fall: float, bound: str, share: float) -> dict[str, Any]:
    """Return hint and advice: a gamma of 1 - share, where the episode is long enough for one."""
    if case.episode_s < fall:
        return {"hint": f"episodes longer than {fall:.2g} s first: no gamma reaches a fall and ends within an episode"}
    gamma = round(1.0 - share, 12)
    return {"hint": f"gamma of at {bound} {gamma:g}", "advice": ({_GAMMA: gamma},)}


@rule
def late_average(case: Case) -> Iterator[Finding]:
    """A mean of the policy's weights that is much of what they were at the beginning of the training.

    It is the mean of all n iterations at first, and m += (w - m) / n behind these: (1 - 1/n)^(i - n) of that is left
    after i iterations, in what is played, be the beginning noise or the policy of ``init_from``. Source: the weights of
    an exponential mean.
    """
    reach, iterations = int(case.agent.get("average_iterations") or 0), int(case.agent["max_iterations"])
    if reach < 2:
        return
    early = (1.0 - 1.0 / reach) ** max(iterations - reach, 0)
    if early > _EARLY:
        few = int(iterations / (1.0 - math.log(_EARLY)))  # (1 - 1/n)^(i - n) is at most exp(1 - i/n)
        enough = few if few > 1 else 0  # the mean of one is no mean
        yield Finding(
            _AVERAGE,
            f"{100 * early:.0f} % of what is played is of iterations 1 to {min(reach, iterations)} of {iterations}",
            f"at most {enough}, or more iterations",
            {"early_share": early},
            ({_AVERAGE: enough},),
        )
