"""A recorded step does what the step itself does, to the bit; a tape of operations stands in for a CUDA graph."""

from __future__ import annotations

import pytest
import torch
from sim.small_envs import ASSETS
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.captured import Captured, Counting
from wheelleg_exp.env.captured_step import CapturedReset, CapturedStep, captured_commands, captured_look
from wheelleg_exp.managers.term import TermBase

# What a graph cannot hold: the host waits for a number, or brings one.
WAITS = ("_local_scalar_dense", "nonzero", "lift_fresh")


class Tape(TorchDispatchMode):
    """Notes torch's operations with their memory, and does them again on the same memory."""

    def __init__(self, streams=()) -> None:
        super().__init__()
        self.notes: list = []
        self.is_new = True

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        assert operation.__name__.split(".")[0] not in WAITS
        result = operation(*args, **(kwargs or {}))
        self.notes.append((operation, args, kwargs or {}, result))
        return result

    def record(self, work):
        with self:
            work()

    def replay(self):
        if self.is_new:  # a graph's recording does nothing, the tape's has done it
            self.is_new = False
            return
        for operation, args, kwargs, result in self.notes:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_flatten(result)[0], tree_flatten(again)[0], strict=True):
                if isinstance(old, torch.Tensor) and old.numel() and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def stand(task: str = "stand") -> ManagerBasedRLEnv:
    words = [f"task={task}", "env.num_envs=16", "env.sim.nthread=1", "env.episode_length_s=0.5"]
    env = ManagerBasedRLEnv(compose(words).config["env"], ASSETS / "legged.xml", 0)
    env.reset(seed=0)
    return env


def parts(env: ManagerBasedRLEnv) -> list[Captured]:
    step = env._captured
    return [step.act, step.act_again, step.judge, step.reward, env._captured_look, env._captured_commands]


@pytest.fixture(autouse=True)
def _taped(monkeypatch):
    monkeypatch.setattr("wheelleg_exp.env.captured_step.CudaGraph", Tape)
    monkeypatch.setattr("wheelleg_exp.env.captured_step._OFTEN", 2)
    soon = lambda timers, least, dt: bool((timers <= dt).any())  # noqa: E731  # what is known of a GPU beforehand
    monkeypatch.setattr("wheelleg_exp.managers.command_manager.may_be_due", soon)
    monkeypatch.setattr("wheelleg_exp.managers.finite.is_finite", lambda total: True)  # on a CPU it asks for the number


def recorded(env: ManagerBasedRLEnv) -> ManagerBasedRLEnv:
    """Let an environment's step be taped as a GPU's would be captured."""
    env._captured = CapturedStep(env)
    env._captured_look = captured_look(env)
    env._captured_reset = CapturedReset(env)
    env._captured_commands = captured_commands(env)
    return env


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


class Counts:
    """Something that counts its steps."""

    __module__ = "wheelleg_exp.fake"

    def __init__(self) -> None:
        self.count = 0

    def work(self) -> None:
        self.count += 1


def test_what_counts_is_refused_with_what_to_set():
    counts = Counts()
    with pytest.raises(Counting, match="'count' of Counts counts, which a recorded step cannot") as told:
        Captured(counts.work, [counts], Tape, lambda: None)()
    assert told.value.key == "env.sim.graph_step"


class Remembers(TermBase):
    """A user's term, of a package of theirs: it lets an attribute hold another tensor at each step."""

    def __init__(self) -> None:
        self.now, self.last = torch.zeros(2), torch.zeros(2)

    def work(self) -> torch.Tensor:
        change = self.now - self.last
        self.last = self.now.clone()
        return change


class HandsOn(Remembers):
    """A user's term that hands on a tensor as it is."""

    def work(self) -> torch.Tensor:
        self.last += 1.0
        return self.now


def test_a_tensor_that_is_handed_on_is_that_of_now():
    term = HandsOn()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 7):
        term.now = torch.full((2,), float(step))
        assert part().tolist() == [step, step]


def test_what_a_term_of_a_users_own_remembers_goes_on():
    term = Remembers()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 7):
        term.now.fill_(float(step))
        assert part().tolist() == [1.0, 1.0]


class Differs(TermBase):
    """Compares two attributes that a user sets between the steps."""

    def __init__(self) -> None:
        self.now, self.last = torch.zeros(2), torch.zeros(2)

    def work(self) -> torch.Tensor:
        return self.now - self.last


@pytest.mark.parametrize("order", [("now", "last"), ("last", "now")])
def test_a_tensor_that_is_passed_on_between_two_attributes_keeps_its_numbers(order):
    term = Differs()
    values = vars(term)
    term.__dict__ = {name: values[name] for name in order}  # the order in which they are brought into memory
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 8):
        term.last = term.now
        term.now = torch.full((2,), float(step * step))
        assert part().tolist() == [2 * step - 1] * 2


class Parts(TermBase):
    """As a user's term whose attributes are one tensor at first, and its own."""

    def __init__(self, *order: str) -> None:
        one = torch.zeros(2)
        for name in order:
            setattr(self, name, one)
        self.is_double = False

    def work(self) -> torch.Tensor:
        change = (self.now - self.last) * (2.0 if self.is_double else 1.0)
        if self.is_double:
            self.now, self.last = self.now + 0.0, self.last + 0.0
        return change


@pytest.mark.parametrize("doubles", [(), (2, 7, 8, 9)])
@pytest.mark.parametrize("order", [("now", "last"), ("last", "now")])
def test_attributes_that_were_one_tensor_may_part(order, doubles):
    """Also where a second recording is made behind a value that was passed on."""
    term = Parts(*order)
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 12):
        new = torch.full((2,), float(step * step))
        term.last, term.now = (term.now if step > 4 else new), new
        term.is_double = step in doubles
        expected = (2 * step - 1) * (2 if step in doubles else 1) if step > 4 else 0
        assert part().tolist() == [expected] * 2


class Looks(TermBase):
    """A user's term that looks at a part of its own memory, set between the steps."""

    def __init__(self) -> None:
        self.memory = torch.arange(20.0)
        self.seen = self.memory[:4]

    def work(self) -> torch.Tensor:
        return self.seen.sum() + 0.0


@pytest.mark.filterwarnings("ignore:a part of the step is launched kernel by kernel")
def test_what_is_seen_through_an_attribute_is_not_overwritten():
    term = Looks()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(80):  # so often that it is given up
        first = 3 * (step % 5)
        term.seen = term.memory[first : first + 4]
        assert float(part()) == 4 * first + 6
        assert torch.equal(term.memory, torch.arange(20.0))
    assert part._fails


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


class Waits(TermBase):
    """Reads a tensor, and holds another that each step replaces by one of another shape."""

    def __init__(self) -> None:
        self.now, self.beside = torch.zeros(2), torch.zeros(1)

    def work(self) -> torch.Tensor:
        return self.now + 1.0


def test_what_a_part_does_not_read_may_take_any_shape_and_the_recording_stays():
    term = Waits()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(8):
        term.now.fill_(float(step))
        term.beside = torch.zeros(step)
        assert part().tolist() == [step + 1.0] * 2
        made = part._variants
    variant = next(iter(made.values()))
    term.beside = torch.zeros(9)
    part()
    assert list(part._variants.values()) == [variant]
    assert [slot.way for slot, _ in variant.before] == [("now",)]


def test_another_tensor_in_the_place_of_one_that_a_part_reads_is_brought_into_its_memory():
    term = Waits()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(8):
        term.now = torch.full((2,), float(step))
        assert part().tolist() == [step + 1.0] * 2
    term.now = torch.zeros(3)
    assert part().tolist() == [1.0] * 3
