"""A recorded step does what the step itself does, to the bit; a tape of operations stands in for a CUDA graph."""

from __future__ import annotations

import pytest
import torch

from env.taping import Tape, parts, recorded, stand
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.captured import Captured, Counting


@pytest.fixture(autouse=True)
def _taped(monkeypatch):
    monkeypatch.setattr("wheelleg_exp.env.captured_step.CudaGraph", Tape)
    monkeypatch.setattr("wheelleg_exp.env.captured_step._OFTEN", 2)
    soon = lambda timers, least, dt: bool((timers <= dt).any())  # noqa: E731  # what is known of a GPU beforehand
    monkeypatch.setattr("wheelleg_exp.managers.command_manager.may_be_due", soon)
    monkeypatch.setattr(
        "wheelleg_exp.managers.non_finite.is_finite", lambda total: True
    )  # on a CPU it asks for the number


def test_a_recorded_step_is_the_step_to_the_bit_through_resets_and_a_changed_weight():
    plain, taped = stand("walk"), recorded(stand("walk"))
    gen = torch.Generator().manual_seed(1)
    ended = 0
    for index in range(60):
        action = 0.4 * torch.randn(16, plain.action_manager.total_action_dim, generator=gen)
        if index == 40:
            for env in (plain, taped):
                env.reward_manager.get_term_cfg("alive").weight = 3.0
        ours, theirs = taped.step(action), plain.step(action)
        assert torch.equal(ours[0]["critic"], theirs[0]["critic"])
        assert torch.equal(ours[1], theirs[1])
        assert torch.equal(ours[2], theirs[2])
        for key, value in plain.extras["log"].items():
            assert float(taped.extras["log"][key]) == pytest.approx(float(value), rel=1e-6, abs=1e-9)
        assert torch.equal(taped.scene.sim.state, plain.scene.sim.state)
        assert taped.common_step_counter == plain.common_step_counter
        ended += int((theirs[2] | theirs[3]).sum())
    assert ended > 16
    assert all(1 <= len(part._variants) <= 6 for part in parts(taped))
    resets = taped._captured_reset._parts.values()
    assert sum(len(part._variants) for part in resets) >= 2
    assert not any(part._fails for part in resets)


def _clips_what_is_seen(env: ManagerBasedRLEnv, who: str) -> list[int]:
    """Let somebody clip observed angular velocities, once within a step; return when, as it is done."""
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
    elif who == "a curriculum":
        env.curriculum_manager.compute = clip
    else:
        env.event_manager.apply_due = clip
    return done


@pytest.mark.parametrize("who", ["an observer", "a curriculum", "an event"])
def test_what_somebody_changes_within_a_step_is_seen_in_that_step(who):
    plain, taped = stand("walk"), recorded(stand("walk"))
    done = [_clips_what_is_seen(env, who) for env in (plain, taped)]
    for _ in range(40):
        ours, theirs = taped.step(torch.zeros(16, 6)), plain.step(torch.zeros(16, 6))
        assert torch.equal(ours[0]["policy"], theirs[0]["policy"])
    assert done[0] == done[1] != []


def _fails(env: ManagerBasedRLEnv, who: str) -> torch.Tensor:
    """Let something be no number in the coming step; return the actions for it."""
    action = torch.zeros(16, 6)
    if "a reward" in who:
        env.action_manager.action[3] = 1e30  # the rate of actions is infinite then
    if "physics" in who:
        action[5] = torch.nan
    if "which ends" in who:
        env.episode_length_buf[3] = env.max_episode_length
    if "as another" in who:
        env.episode_length_buf[9] = env.max_episode_length
    return action


@pytest.mark.parametrize("watched", [False, True])
@pytest.mark.parametrize(
    "who", ["a reward", "physics", "a reward and physics", "a reward which ends", "a reward as another"]
)
def test_whose_reward_is_no_number_ends_in_that_step_though_it_is_known_late(watched, who):
    found = []
    for env in (stand("walk"), recorded(stand("walk"))):
        env.observers += [lambda: None] if watched else []
        resets = []
        env.curriculum_manager.compute = lambda ids, resets=resets: resets.append(ids.tolist())
        for index in range(7):
            env.action_manager.action.zero_()
            action = _fails(env, who) if index == 5 else torch.zeros(16, 6)
            observations, reward, terminated, _, extras = env.step(action)
            assert reward.isfinite().all()
            keys = extras.get("non_finite", {"keys": {}})["keys"]
            log = float(extras["log"]["Episode_Reward/alive"]) if index == 5 and "another" in who else 0.0
            rows = torch.tensor([0, 1, 2])  # of others than those are drawn
            found.append(
                (
                    observations["critic"][rows],
                    reward if index < 6 else reward[rows],
                    terminated,
                    keys,
                    log,
                    sorted(i for ids in resets for i in ids),
                )
            )
    plain, taped = found[:7], found[7:]
    for theirs, ours in zip(plain, taped, strict=True):
        assert all(map(torch.equal, theirs[:3], ours[:3]))
        assert theirs[3] == ours[3]
        assert theirs[5] == ours[5]
    assert plain[5][3]
    assert not plain[6][3]
    if "another" in who:  # alive for 6 steps of 1/60 s in episodes of 0.5 s; the one that fails for 5
        assert plain[5][4] == pytest.approx((0.2 + 0.5 / 3) / 2)
        assert taped[5][4] == pytest.approx(plain[5][4] if watched else 0.2)


def test_a_recorded_reset_draws_from_the_ranges_of_now():
    env = recorded(stand())
    term = env.command_manager.get_term("base_velocity")
    for speed in (0.1, 0.1, 0.1, 0.1, 0.1, 0.3, 0.1):
        term.ranges["lin_vel_x"] = [speed, speed]
        env._reset_idx(torch.arange(4))
        assert term.command[:4, 0].tolist() == pytest.approx([speed] * 4)
    assert env._captured_reset._parts[4]._variants


def test_numbers_that_no_longer_end_together_make_room_for_those_that_do(monkeypatch):
    monkeypatch.setattr("wheelleg_exp.env.captured_step._MOST_COUNTS", 2)
    monkeypatch.setattr("wheelleg_exp.env.captured_step._RECENT", 8)
    plain, env = stand(), recorded(stand())
    kept = []
    for count in (9, 9, 7, 7, 9, 3, 3, 3, 3, 2, 1, 2, 2, 3, 2):
        for each in (plain, env):
            each._reset_idx(torch.arange(count))
        kept.append(sorted(env._captured_reset._parts))
        assert torch.equal(env.scene.sim.state, plain.scene.sim.state)
    assert kept[4] == [7, 9]
    assert kept[7] == [7, 9]  # 3 has come up three times and 7 twice, which is no reason to record anew
    assert kept[8] == [3, 7]  # four times, and 9 as seldom as 7
    assert kept[-1] == [2, 3]
    assert env._captured_reset._seen.total() == 8


def test_what_was_recorded_is_entered_by_a_look_at_places_alone(monkeypatch):
    """Measurements and resets leave the containers of tensors where they were."""
    env = recorded(stand("walk"))
    gen = torch.Generator().manual_seed(1)
    actions = 0.4 * torch.randn(90, 16, env.action_manager.total_action_dim, generator=gen)
    for action in actions[:60]:
        env.step(action)
    slow = []
    own = Captured._enter
    monkeypatch.setattr(Captured, "_enter", lambda part, variant: slow.append(part) or own(part, variant))
    for action in actions[60:]:
        env.step(action)
    fast = [*parts(env), *env._captured_reset._parts.values()]
    assert len(slow) < 0.1 * 5 * 30, [fast.index(part) for part in slow]


def test_a_reset_kernel_by_kernel_leaves_what_was_recorded_to_be_entered_at_once(monkeypatch):
    """Each recording would have to be found again: of resets there are up to a hundred and more."""
    env = recorded(stand("walk"))
    for count in (3, 3, 3, 5, 5, 5):
        env._reset_idx(torch.arange(count))
        env.step(torch.zeros(16, env.action_manager.total_action_dim))
    before = env._captured_memory.version
    monkeypatch.setattr(Captured, "_enter", lambda part, variant: pytest.fail("what was there has been looked for"))
    for count in (3, 4, 3, 2, 5):
        env._reset_idx(torch.arange(count))
        env._captured.act()
    assert env._captured_memory.version == before
    assert sorted(env._captured_reset._parts) == [3, 5]


def test_a_recorded_reset_that_is_the_first_to_push_a_body_pushes_it_again():
    """What a state that was loaded knew nothing of."""
    plain, env = stand(), recorded(stand())
    for _ in range(8):
        for each in (plain, env):
            robot = each.scene.robot
            assert robot.state_dict()["wrench_bodies"] == [0]
            robot.load_state_dict({**robot.state_dict(), "wrench_bodies": []})
            each._reset_idx(torch.arange(3))
            each.step(torch.zeros(16, each.action_manager.total_action_dim))
        assert torch.equal(env.scene.sim.state, plain.scene.sim.state)
    assert list(env._captured_reset._parts) == [3]


def test_a_reset_in_which_counting_is_noticed_is_done_once():
    plain, taped = stand(), recorded(stand())
    for env in (plain, taped):
        manager, own = env.action_manager, env.action_manager.reset
        manager.count = 0

        def reset(ids, manager=manager, own=own):
            manager.count += 1
            return own(ids)

        manager.reset = reset
    gen = torch.Generator().manual_seed(1)
    for _ in range(40):
        action = 0.4 * torch.randn(16, plain.action_manager.total_action_dim, generator=gen)
        taped.step(action), plain.step(action)
        assert taped.action_manager.count == plain.action_manager.count
        for key, value in plain.extras["log"].items():
            assert float(taped.extras["log"][key]) == pytest.approx(float(value), rel=1e-6, abs=1e-9)
        assert torch.equal(taped.scene.sim.state, plain.scene.sim.state)
    assert not taped._captured_reset._works


def test_a_reset_that_could_not_be_recorded_is_an_error_and_not_taken_for_done(monkeypatch):
    env = recorded(stand())

    def begins_to_change(part):
        raise Counting("'kept' of a term has begun to change", key="env.sim.graph_step")

    for _ in range(3):
        env._reset_idx(torch.arange(4))
    monkeypatch.setattr(Captured, "__call__", begins_to_change)
    with pytest.raises(Counting, match="has begun to change"):
        env._reset_idx(torch.arange(4))


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
def test_a_setting_that_a_curriculum_moves_from_step_to_step_counts_as_it_is(kind, address, way, more):
    schedule = f"{{start: {way[0]}, end: {way[1]}, num_steps: 40}}"
    change = (
        f"+env.curriculum.change={{_target_: wheelleg_exp.mdp.curriculums.{kind}, address: '{address}', "
        f"modify_fn: wheelleg_exp.mdp.schedules.linear, modify_params: {schedule}}}"
    )
    plain, taped = stand("walk", *more, change), recorded(stand("walk", *more, change))
    gen = torch.Generator().manual_seed(1)
    for _ in range(60):
        action = 0.4 * torch.randn(16, plain.action_manager.total_action_dim, generator=gen)
        theirs, ours = plain.step(action), taped.step(action)
        assert torch.equal(ours[0]["policy"], theirs[0]["policy"])
        assert all(torch.equal(our, their) for our, their in zip(ours[1:4], theirs[1:4], strict=True))
    for _ in range(10):
        taped.step(torch.zeros(16, plain.action_manager.total_action_dim))
    assert [part._variants.missed for part in parts(taped)] == [0] * 6  # it stands still, and is recorded again
