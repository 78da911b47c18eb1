"""Test that a captured step is bit-identical to the step without graphs. A tape replaces the CUDA graph."""

from __future__ import annotations

import pytest
import torch

from env.tape import make_env
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.graph_capture import CapturedPart, CudaGraph
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.rl.vec_env import RslRlVecEnv

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _as_on_a_gpu(monkeypatch):
    due = lambda timers, least, dt: bool((timers <= dt).any())  # noqa: E731  # on a GPU the host knows a bound only
    monkeypatch.setattr("wheelleg_exp.managers.command_manager.may_be_due", due)
    # On a CPU, the original function reads the number.
    monkeypatch.setattr("wheelleg_exp.managers.non_finite.is_finite", lambda total: True)


def pair(task: str = "stand", *overrides: str) -> tuple[ManagerBasedRLEnv, ManagerBasedRLEnv]:
    """Return two equal environments: without and with graph capture."""
    return make_env(task, *overrides), make_env(task, *overrides, captured=True)


def random_actions(env: ManagerBasedRLEnv, steps: int) -> torch.Tensor:
    gen = torch.Generator().manual_seed(1)
    return 0.4 * torch.randn(steps, 16, env.action_manager.total_action_dim, generator=gen)


def resets(env: ManagerBasedRLEnv) -> CapturedPart:
    return env.graph_capture.parts["_reset_rows"]


def counts(part: CapturedPart) -> list[int]:
    """Return the numbers of environments for which a reset has been recorded."""
    return sorted({key[0][1][0] for key in part.recordings})


def assert_equal_steps(plain: ManagerBasedRLEnv, captured: ManagerBasedRLEnv, actions: torch.Tensor) -> int:
    """Check that both environments give the same results; return the number of episodes that ended."""
    ended = 0
    for action in actions:
        ours, theirs = captured.step(action), plain.step(action)
        assert all(torch.equal(ours[0][group], theirs[0][group]) for group in ("policy", "critic"))
        assert all(map(torch.equal, ours[1:4], theirs[1:4]))
        assert torch.equal(captured.scene.sim.state, plain.scene.sim.state)
        assert captured.common_step_counter == plain.common_step_counter
        ended += int((theirs[2] | theirs[3]).sum())
        for key, value in plain.extras["log"].items():
            assert float(captured.extras["log"][key]) == pytest.approx(float(value), rel=1e-6, abs=1e-9)
    return ended


def test_a_captured_step_equals_the_step_through_resets_and_a_changed_weight():
    plain, captured = pair("walk")
    actions = random_actions(plain, 50)
    ended = assert_equal_steps(plain, captured, actions[:35])
    for env in (plain, captured):
        env.reward_manager.get_term_cfg("alive").weight = 3.0
    assert ended + assert_equal_steps(plain, captured, actions[35:]) > 16
    parts = captured.graph_capture.parts
    assert len(parts) == 7
    assert all(1 <= len(part.recordings) <= 6 for part in parts.values())
    assert not any(part.fails for part in parts.values())


def test_a_captured_environment_saves_and_loads_its_state():
    plain, captured = pair("walk")
    actions = random_actions(plain, 55)
    for action in actions[:35]:
        captured.step(action)
    captured.reward_manager.get_term_cfg("alive").weight = 3.0
    captured.step(actions[35])
    plain.load_state_dict(captured.state_dict())
    assert_equal_steps(plain, captured, actions[36:45])
    captured.load_state_dict(plain.state_dict())
    assert_equal_steps(plain, captured, actions[45:])
    assert captured.state_dict().keys() == plain.state_dict().keys()


def _clip_observations_late(env: ManagerBasedRLEnv, who: str) -> list[int]:
    """Change the clip of observed angular velocities in the tenth step; return a list that this step appends to."""
    terms = [terms["base_ang_vel"] for terms in env.observation_manager._groups.values()]
    done: list[int] = []

    def clip(*_):
        if env.common_step_counter > 8 and not done:
            done.append(env.common_step_counter)
            for term in terms:
                term._clip = (-0.1, 0.1)
        return True

    if who == "an observer":
        env.observers.append(clip)
    elif who == "a command":
        compute = env.command_manager.compute
        env.command_manager.compute = lambda dt, draws: compute(dt, draws) or (draws and clip())
    elif who == "a curriculum":
        env.curriculum_manager._terms["clip"] = clip  # The curriculum manager must not be empty.
        env.curriculum_manager.compute = clip
        env.curriculum_manager.reset = lambda ids: {}
    else:
        env.event_manager.apply_due = clip
    return done


@pytest.mark.parametrize("who", ["an observer", "a command", "a curriculum", "an event"])
def test_a_setting_that_changes_within_a_step_counts_in_that_step(who):
    plain, captured = pair("walk", "env.commands.base_velocity.resampling_time_range=[0.25, 0.3]")
    done = [_clip_observations_late(env, who) for env in (plain, captured)]
    assert_equal_steps(plain, captured, torch.zeros(20, 16, 6))
    assert done[0] == done[1] != []


def _cause_failure(env: ManagerBasedRLEnv, what: str) -> torch.Tensor:
    """Make a number NaN or inf in the next step; return the actions for that step."""
    action = torch.zeros(16, 6)
    if "a reward" in what:
        env.action_manager.action[3] = 1e30  # The squared action rate becomes inf.
    if "physics" in what:
        action[5] = torch.nan
    if "that ends" in what:
        env.episode_length_buf[3] = env.max_episode_length
    if "as another ends" in what:
        env.episode_length_buf[9] = env.max_episode_length
    return action


@pytest.mark.parametrize(
    "what",
    [
        *("a reward", "physics, observed", "a reward and physics", "a reward that ends, observed"),
        *("a reward as another ends", "a reward as another ends, observed"),
    ],
)
def test_an_episode_whose_reward_is_not_finite_ends_in_that_step(what):
    found = []
    for env in pair("walk"):
        env.observers += [lambda: None] if "observed" in what else []
        reset_ids = []
        env.curriculum_manager.compute = lambda ids, reset_ids=reset_ids: reset_ids.append(ids.tolist())
        for index in range(7):
            env.action_manager.action.zero_()
            action = _cause_failure(env, what) if index == 5 else torch.zeros(16, 6)
            observations, reward, terminated, _, extras = env.step(action)
            assert reward.isfinite().all()
            keys = extras.get("non_finite", {"keys": {}})["keys"]
            log = float(extras["log"]["Episode_Reward/alive"]) if index == 5 and "another" in what else 0.0
            rows = torch.tensor([0, 1, 2])  # After the failure, random numbers of other rows differ.
            shown = observations["critic"][rows], reward if index < 6 else reward[rows], terminated
            found.append((*shown, keys, log, sorted(i for ids in reset_ids for i in ids)))
    plain, captured = found[:7], found[7:]
    for theirs, ours in zip(plain, captured, strict=True):
        assert all(map(torch.equal, theirs[:3], ours[:3]))
        assert (theirs[3], theirs[5]) == (ours[3], ours[5])
    assert plain[5][3]
    assert not plain[6][3]
    if "another" in what:  # Episodes last 6 steps of 1/60 s, and the failed one 5.
        assert plain[5][4] == pytest.approx((0.2 + 0.5 / 3) / 2)
        assert captured[5][4] == pytest.approx(plain[5][4] if "observed" in what else 0.2)


def test_a_captured_reset_draws_from_the_present_ranges():
    env = make_env(captured=True)
    term = env.command_manager.get_term("base_velocity")
    for speed in (0.1, 0.1, 0.1, 0.1, 0.1, 0.3, 0.1):
        term.ranges["lin_vel_x"] = [speed, speed]
        env.reset(env_ids=torch.arange(4))
        assert term.command[:4, 0].tolist() == pytest.approx([speed] * 4)
    assert counts(resets(env)) == [4]


def test_a_reset_has_a_recording_for_each_number_of_environments_that_occurs_often(monkeypatch):
    monkeypatch.setattr("wheelleg_exp.env.graph_capture._RESET_RECORDINGS", 2)
    monkeypatch.setattr("wheelleg_exp.env.graph_capture._CALLS_PER_RECORDING", 3)
    plain, env = pair()
    found = []
    for count in (9, 9, 9, 9, 7, 7, 7, 3, 3, 3, 3, 3, 9, 3):
        for each in (plain, env):
            each._reset_idx(torch.arange(count))
        found.append(counts(resets(env)))
        assert torch.equal(env.scene.sim.state, plain.scene.sim.state)
    assert found[6] == found[9] == [7, 9]
    assert found[11] == [3, 7]  # The recording for 9 environments was not used in six calls.
    assert found[13] == [3, 7]


@pytest.mark.parametrize("words", [[], ["env.realism.exact_share=0.5", "env.realism.actions.prompt_share=0.25"]])
def test_steps_and_resets_with_realism_are_captured(words):
    plain, env = pair("walk", "realism=full", *words)
    for _ in range(4):
        for each in (plain, env):
            each._reset_idx(torch.arange(9))
    assert counts(resets(env)) == [9]
    assert_equal_steps(plain, env, random_actions(plain, 20))
    assert not any(part.fails for part in env.graph_capture.parts.values())


_NOISE = (
    "env.observations.policy.enable_corruption=true",
    "+env.observations.policy.terms.base_ang_vel.noise"
    "={_target_: wheelleg_exp.mdp.noise.UniformNoise, n_min: -0.2, n_max: 0.2}",
)


@pytest.mark.parametrize(
    ("kind", "address", "way", "more"),
    [
        ("modify_term_cfg", "observations.policy.base_ang_vel.noise.n_max", (0.1, 1.0), _NOISE),
        ("modify_env_param", "max_episode_length", (30.0, 8.0), ()),
        ("modify_term_cfg", "rewards.track_lin_vel_xy.params.std", (0.1, 0.9), ()),
    ],
)
def test_a_setting_that_a_curriculum_changes_in_each_step_counts_in_each_step(kind, address, way, more):
    schedule = f"{{start: {way[0]}, end: {way[1]}, num_steps: 30}}"
    change = (
        f"+env.curriculum.change={{_target_: wheelleg_exp.mdp.curriculums.{kind}, address: '{address}', "
        f"modify_fn: wheelleg_exp.mdp.schedules.linear, modify_params: {schedule}}}"
    )
    plain, captured = pair("walk", *more, change)
    assert_equal_steps(plain, captured, random_actions(plain, 45))
    for _ in range(10):
        captured.step(torch.zeros(16, plain.action_manager.total_action_dim))
    parts = captured.graph_capture.parts
    assert [part._missed for name, part in parts.items() if name != "_reset_rows"] == [0] * 6


class FakeCapture:
    streams: list[str]

    def __init__(self, graph, capture_error_mode="") -> None:
        pass

    def __enter__(self) -> None:
        self.streams.append("the capture's")

    def __exit__(self, kind, error, trace) -> None:
        if kind is not None:
            raise RuntimeError("CUDA error: operation failed due to a previous error during capture")
        self.streams.pop()


@pytest.fixture
def streams(monkeypatch):
    used = ["the step's"]
    monkeypatch.setattr(FakeCapture, "streams", used, raising=False)
    monkeypatch.setattr(torch.cuda, "graph", FakeCapture)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: None)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: used[-1])
    monkeypatch.setattr(torch.cuda, "set_stream", used.append)
    monkeypatch.setattr(torch, "zeros", lambda *sizes, device: None)
    return used


def test_a_capture_restores_the_stream_and_a_failed_one_raises_the_error_of_the_work(streams):
    done = []
    CudaGraph([]).record(lambda: done.append(streams[-1]))
    assert (done, streams[-1]) == (["the capture's"], "the step's")

    def work() -> None:
        try:
            raise RuntimeError("operation not permitted when stream is capturing")
        except RuntimeError as error:
            raise SimulationFailure("'mine.asks' raises RuntimeError", key="env.rewards.asks") from error

    with pytest.raises(SimulationFailure, match=r"env\.rewards\.asks: 'mine\.asks' raises") as caught:
        CudaGraph([]).record(work)
    assert "not permitted" in str(caught.value.__cause__)
    assert streams[-1] == "the step's"


def test_observations_that_a_training_keeps_outlive_the_next_step():
    adapter = RslRlVecEnv(make_env("walk", captured=True))
    actions = random_actions(adapter.env, 6)
    for action in actions[:5]:
        adapter.step(action)
    seen = adapter.get_observations()
    before = seen["policy"].clone()
    adapter.step(actions[5])
    assert torch.equal(seen["policy"], before)
