"""Test mirror images against the physics and against hand-computed signs."""

import copy

import mujoco
import numpy as np
import pytest
import torch

from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.mirror_pairs import joint_images, joint_signs
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.symmetry import left_right, replace_mirror_loss
from wheelleg_exp.rl.vec_env import RslRlVecEnv

from .conftest import saved

MIRRORED = "agent=ppo_symmetry"
SETTINGS = "agent.algorithm.symmetry_cfg"
CALM = ["event@env.events=[]", "env.terminations.leg_contact=null", "env.terminations.base_contact=null"]
LASTING = [f"env.commands.base_velocity.{word}" for word in ("resampling_time_range=[9,9]", "rel_standing_envs=0.0")]
# The joints l01, r01, l02, r02, l03, r03 change sides, and all axes are +y, so no sign changes.
SIDES = [1, 0, 3, 2, 5, 4]
ACTIONS = [2, 3, 0, 1, 5, 4]  # The order is l01, l02, r01, r02, l03, r03.


@pytest.fixture(scope="module")
def adapter(make_trainer):
    return make_trainer(MIRRORED, *CALM, "env.num_envs=32", *LASTING).env


def write_twins(env, ids=None):
    """Set random states near the ground in 16 environments, and their mirror images in the other 16."""
    env.autoreset = "disabled"
    env.reset()
    robot, half, generator = env.scene.robot, 16, torch.Generator().manual_seed(4)

    def draw(*shape, size=1.0):
        return size * (2.0 * torch.rand(*shape, generator=generator) - 1.0)

    pos = torch.tensor([0.0, 0.0, 0.072]) + draw(half, 3, size=0.004)
    quat = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 0.0, 0.0]) + draw(half, 4, size=0.1), dim=1)
    lin, ang = draw(half, 3, size=0.3), draw(half, 3, size=2.0)
    q, v = robot.layout.default_joint_pos + draw(half, 6, size=0.2), draw(half, 6, size=3.0)
    ids = torch.arange(32) if ids is None else ids
    pose, velocity = torch.cat((pos, quat), dim=1), torch.cat((lin, ang), dim=1)
    pose = torch.cat((pose, pose * torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])))
    pose[:, :3] += env.scene.env_origins[ids]
    robot.write_root_pose_to_sim(pose, ids)
    mirrored = velocity * torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    robot.write_root_velocity_to_sim(torch.cat((velocity, mirrored)), ids)
    robot.write_joint_state_to_sim(torch.cat((q, q[:, SIDES])), torch.cat((v, v[:, SIDES])), env_ids=ids)
    command = env.command_manager.get_term("base_velocity")
    vx_vy_wz = draw(half, 3)
    command.command[ids] = torch.cat((vx_vy_wz, vx_vy_wz * torch.tensor([1.0, -1.0, -1.0])))
    env.scene.refresh()


def test_the_image_of_a_state_steps_to_the_image_of_the_next_state(adapter):
    env, half = adapter.env, 16
    write_twins(env)
    generator = torch.Generator().manual_seed(7)
    contacts = 0.0
    for _ in range(12):
        one = 2.0 * torch.rand(half, 6, generator=generator) - 1.0
        image = one[:, ACTIONS]
        env.step(torch.cat((one, image)))
        seen = adapter.get_observations()
        contacts += float(env.scene["contact_forces"].data.net_forces_w.abs().sum())
        for group in ("policy", "critic"):
            got, expected = adapter.mirror.observations(seen[:half])[group], seen[half:][group]
            torch.testing.assert_close(got, expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(adapter.mirror.actions(one), image)
    assert contacts > 1.0
    still = adapter.get_observations()[half:]["policy"]
    assert (adapter.get_observations()[:half]["policy"] - still).abs().max() > 0.5  # The mirrored observations differ.


def test_every_second_robot_met_in_a_mirror_is_as_its_twin(make_trainer):
    adapter = make_trainer("agent=ppo_mirrored", *CALM, "env.num_envs=32", *LASTING).env
    env, ones, images = adapter.env, torch.arange(0, 32, 2), torch.arange(1, 32, 2)
    write_twins(env, torch.cat((ones, images)))
    generator = torch.Generator().manual_seed(7)
    for _ in range(12):
        one = 2.0 * torch.rand(16, 6, generator=generator) - 1.0
        seen, rewards, dones, _ = adapter.step(one.repeat_interleave(2, dim=0))
        for group in ("policy", "critic"):
            torch.testing.assert_close(seen[group][images], seen[group][ones], atol=1e-4, rtol=1e-4)
            assert torch.equal(adapter.get_observations()[group], seen[group])
        torch.testing.assert_close(rewards[images], rewards[ones], atol=1e-4, rtol=1e-3)
        assert torch.equal(dones[images], dones[ones])
    raw = env.action_manager.action
    torch.testing.assert_close(raw[images], one[:, ACTIONS])  # Mirrored robots get mirrored actions.
    assert (env.observation_manager.obs_buf["policy"][images] - seen["policy"][images]).abs().max() > 0.5


def test_a_policy_that_is_played_meets_no_robot_in_a_mirror(make_trainer, tmp_path):
    trainer = make_trainer("agent=ppo_mirrored", "env.num_envs=3")
    played = RslRlVecEnv(trainer.env.env)
    load_policy(saved(trainer.state_dict(), tmp_path), played, trainer._agent)
    own = played.env.observation_manager.obs_buf["policy"]
    assert torch.equal(played.get_observations()["policy"], own)
    trained = trainer.env.get_observations()["policy"]
    assert [torch.equal(trained[i], own[i]) for i in range(3)] == [True, False, True]


def test_one_robot_has_no_second(make_trainer):
    with pytest.raises(ConfigError, match=r"agent\.symmetry\.mirrored_envs.*there is only one"):
        make_trainer("agent=ppo_mirrored", "env.num_envs=1")


@pytest.mark.filterwarnings("ignore:The observation configuration dictionary")
def test_a_group_that_is_not_named_for_the_critic_is_mirrored_too(make_trainer):
    trainer = make_trainer("agent=ppo_mirrored", "~agent.obs_groups.critic", "env.num_envs=4")
    seen, own = trainer.env.get_observations()["critic"], trainer.env.env.observation_manager.obs_buf["critic"]
    assert [torch.equal(seen[i], own[i]) for i in range(4)] == [True, False, True, False]


def test_a_batch_is_followed_by_its_image_and_the_image_of_the_image_is_the_batch(adapter):
    seen, actions = adapter.get_observations(), torch.rand(32, 6)
    twice = adapter.mirror.observations(adapter.mirror.observations(seen))
    assert all(torch.equal(twice[group], seen[group]) for group in ("policy", "critic"))
    observations, both = left_right(adapter, seen, actions)
    assert observations.batch_size == (64,)
    assert torch.equal(observations["critic"][:32], seen["critic"])
    assert torch.equal(both[32:], actions[:, ACTIONS])
    assert (left_right(adapter, None, actions)[0], left_right(adapter, seen, None)[1]) == (None, None)


def test_signs_of_joints_are_those_of_their_axes():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body name="base" pos="1 2 3" quat="0.6 0.8 0 0"><freejoint/><geom size="0.1"/>
        <body pos="0 0.2 0"><joint name="l_roll" axis="1 0 0"/><geom size="0.05"/>
          <body pos="0 0.1 -0.1"><joint name="l_pitch" axis="0 -1 0"/><geom size="0.04"/>
            <body pos="0 0 -.1"><joint name="l_slide" type="slide" axis="0 1 0"/><geom size=".03"/></body></body></body>
        <body pos="0 -0.2 0"><joint name="r_roll" axis="1 0 0"/><geom size="0.05"/>
          <body pos="0 -0.1 -0.1"><joint name="r_pitch" axis="0 1 0"/><geom size="0.04"/>
            <body pos="0 0 -.1"><joint name="r_slide" type="slide" axis="0 1 0"/><geom size=".03"/></body></body></body>
        <body pos="0.1 0 0"><joint name="yaw" axis="0 0 1"/><geom size="0.02"/>
          <body pos="0.1 0 0"><joint name="nod" axis="0 1 0"/><geom size="0.02"/></body></body>
      </body></worldbody></mujoco>""")
    names = ["l_roll", "l_pitch", "l_slide", "r_roll", "r_pitch", "r_slide", "yaw", "nod"]
    images = joint_images(names, {"l_(.*)": r"r_\1"})
    assert images == [3, 4, 5, 0, 1, 2, 6, 7]
    assert joint_signs(model, "base", names, images) == [-1, -1, -1, -1, -1, -1, -1, 1]
    # A pair that is null has no effect.
    assert joint_images(["left", "right", "head"], {r"l(\d+)": None, "left": "right"}) == [1, 0, 2]


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ({"x(.*)": r"r\1"}, "matches no joint"),
        ({"l(.*)": r"s\1"}, "the robot has no joint 's1'"),
        ({"l(": "r"}, "is not a regular expression"),
        ({"l(.*)": r"r\2"}, "regular expression is invalid"),
    ],
)
def test_impossible_pairs_are_rejected(pairs, said):
    with pytest.raises(ConfigError, match=r"agent\.symmetry\.joint_pairs") as caught:
        joint_images(["l1", "r1", "head"], pairs)
    assert said in str(caught.value)


def lopsided(change):
    sides = {"l": 'pos="0 0.2 0"', "r": 'pos="0 -0.2 0"'} | change
    bodies = "".join(
        f'<body {place}><joint name="{side}" axis="0 1 0"/><geom size="0.05" pos="0 0 -0.1"/></body>'
        for side, place in sides.items()
    )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>{bodies}</body></worldbody></mujoco>'
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"r": 'pos="0 -0.21 0"'}, "10.0 mm off"),
        ({"r": 'pos="0 -0.2 0" euler="0 45 0"'}, "off the image"),  # The joint has another zero position.
        ({"r": 'pos="0 -0.2 0" euler="0 0 20"'}, "axes differ by 20.0 degrees"),
    ],
)
def test_joints_that_are_not_mirror_images_are_rejected(change, said):
    assert joint_signs(lopsided({}), "base", ["l", "r"], [1, 0]) == [1, 1]
    with pytest.raises(ConfigError, match="'l' and 'r' are not mirror images") as caught:
        joint_signs(lopsided(change), "base", ["l", "r"], [1, 0])
    assert said in str(caught.value)


UNEVEN_LEGS = "env.robot.init_state.joint_pos={'.*01$': 0.9599, 'l02': -1.0, 'r02': -1.8, '.*03$': 0.0}"


@pytest.mark.parametrize(
    ("words", "key", "said"),
    [
        ([UNEVEN_LEGS], "env.robot", "-1"),
        (["+agent.symmetry.terms={base_ang_vell: vector}"], "agent.symmetry.terms.base_ang_vell", "base_ang_vel"),
        (["+agent.symmetry.terms={base_ang_vel: vectr}"], "agent.symmetry.terms.base_ang_vel", "'vector'"),
        (["+agent.symmetry.terms={base_ang_vel: [1, 1]}"], "env.observations", "the term has 3"),
        (["env.observations.policy.terms.base_ang_vel.scale=[1,2,3]"], None, ""),
        (["env.observations.policy.terms.joint_vel_rel.scale=[1,2,1,1,1,1]"], "joint_vel_rel.scale", "one factor"),
        (["+env.observations.policy.terms.base_ang_vel.clip=[-1,2]"], "base_ang_vel.clip", "[-x, x]"),
        (["env.actions.wheel_vel.scale={l03: 5.0, r03: 4.0}"], "env.actions", "'l03'"),
        (["env.actions.wheel_vel.joint_names=[l03]"], "env.actions", "'r03'"),
    ],
)
def test_a_config_without_a_mirror_image_is_rejected_with_its_key(make_trainer, words, key, said):
    check_mirror(make_trainer, [MIRRORED, *words], key, said)


def test_terms_that_set_no_joint_targets_can_be_images_of_each_other(make_trainer, monkeypatch):
    monkeypatch.setattr("wheelleg_exp.mdp.actions.JointVelocityAction.drives", "")
    right = "{_target_: wheelleg_exp.mdp.actions.JointVelocityAction, joint_names: [r03], scale: 5.0}"
    words = ("env.actions.wheel_vel.joint_names=[l03]", f"+env.actions.right={right}")
    mirror = make_trainer(MIRRORED, *words).env.mirror
    assert mirror.actions(torch.arange(6.0).view(1, 6)).tolist() == [[float(i) for i in ACTIONS]]
    again = [f"+env.actions.{name}2={right.replace('r03', name)}" for name in ("l03", "r03")]
    mirror = make_trainer(MIRRORED, *words, *again).env.mirror
    assert mirror.actions(torch.arange(8.0).view(1, 8))[0, 4:].tolist() == [5.0, 4.0, 7.0, 6.0]


def check_mirror(make_trainer, words, key, said):
    """Check that a config has no mirror image because of ``key``, or that it has one if ``key`` is None."""
    if key is None:
        assert make_trainer(*words).env.mirror is not None
        return
    with pytest.raises(ConfigError) as caught:
        make_trainer(*words)
    assert key in str(caught.value.key)
    assert said in str(caught.value)


@pytest.mark.usefixtures("allow_test_terms")
def test_a_term_without_a_known_image_is_rejected(make_trainer):
    own = "+env.observations.policy.terms.own={_target_: mdp.fakes.two_numbers}"
    with pytest.raises(ConfigError, match=r"agent\.symmetry\.terms\.own.*vector"):
        make_trainer(MIRRORED, own)
    assert make_trainer(MIRRORED, own, "+agent.symmetry.terms={own: [1, -1]}").env.mirror is not None


RULES = "wheelleg_exp.rl.symmetry"


@pytest.mark.parametrize(
    ("key", "value", "nearest"),
    [
        ("+agent.symmetry.terms", "{base_ang_vel: psudovector}", "pseudovector"),
        (f"{SETTINGS}.data_augmentation_func", f"{RULES}.left_rigt", f"{RULES}.left_right"),
    ],
)
def test_an_unknown_word_is_reported_before_anything_is_built(key, value, nearest):
    (error,) = check(compose(["task=stand", MIRRORED, f"{key}={value}"]))
    assert error.key.startswith(key.lstrip("+"))
    assert error.nearest == nearest


@pytest.mark.usefixtures("allow_test_terms")
def test_groups_for_novelty_alone_have_an_image(make_trainer):
    group = "+env.observations.novel={terms: {own: {_target_: mdp.fakes.two_numbers}}}"
    novelty = "{weight: 0.1, num_outputs: 8, predictor_hidden_dims: [8], target_hidden_dims: [8]}"
    words = [group, "+agent.obs_groups.rnd_state=[novel]", f"+agent.algorithm.rnd_cfg={novelty}"]
    with pytest.raises(ConfigError, match=r"agent\.symmetry\.terms\.own"):
        make_trainer("agent=ppo_mirrored", *words)
    trainer = make_trainer("agent=ppo_mirrored", *words, "+agent.symmetry.terms={own: [1, -1]}")
    own = trainer.env.env.observation_manager.obs_buf["novel"]
    assert torch.equal(trainer.env.get_observations()["novel"][1], own[1] * torch.tensor([1.0, -1.0]))


@pytest.mark.train
def test_each_minibatch_holds_the_images_too(make_trainer, monkeypatch):
    trainer, seen = make_trainer(MIRRORED), []
    actor = trainer.algorithm.actor
    forward = type(actor).forward

    def spy(self, observations, *args, **kwargs):
        if self is actor and self.training and torch.is_grad_enabled():
            seen.append(observations["policy"].detach().clone())
        return forward(self, observations, *args, **kwargs)

    monkeypatch.setattr(type(actor), "forward", spy)
    (done,) = trainer.learn(until=1)
    batch = seen[0]
    assert len(batch) == 2 * 16 * 24 // 4
    half = len(batch) // 2
    frame = np.s_[12:15]  # The columns are the latest angular velocity, which is a pseudovector.
    assert torch.equal(batch[half:, frame], batch[:half, frame] * torch.tensor([-1.0, 1.0, -1.0]))
    assert done.scalars["Loss/symmetry"] >= 0.0


@pytest.mark.parametrize("is_learned_from", ["true", "false"])
def test_the_mirror_loss_is_that_of_rsl_rl(make_trainer, monkeypatch, is_learned_from):
    words = ("agent=ppo_mirror_loss", f"{SETTINGS}.use_mirror_loss={is_learned_from}")
    trainer = make_trainer(*words, "agent.actor.obs_normalization=true")
    trainer._collect()
    algorithm = trainer.algorithm
    actor, storage, passes = algorithm.actor, algorithm.storage, []
    batch = next(storage.mini_batch_generator(4, 1))
    size = len(batch.observations)
    forward = type(actor.mlp).forward
    monkeypatch.setattr(type(actor.mlp), "forward", lambda self, x: (passes.append(len(x)), forward(self, x))[1])

    def found(loss):
        actor.zero_grad()
        actor(batch.observations, stochastic_output=True)
        passes.clear()
        value = loss(actor, copy.copy(batch), size)
        if value.requires_grad:
            value.backward()
        return value.detach(), [p.grad.clone() for p in actor.mlp.parameters() if p.grad is not None], sum(passes)

    ours = found(algorithm.symmetry.compute_loss)
    theirs = found(type(algorithm.symmetry).compute_loss.__get__(algorithm.symmetry))
    assert ours[0] > 1e-4
    torch.testing.assert_close(ours[0], theirs[0])
    assert bool(ours[1]) is (is_learned_from == "true")
    torch.testing.assert_close(ours[1], theirs[1])
    assert (ours[2], theirs[2]) == (size, 2 * size)


def test_a_user_defined_mirror_loss_is_used(make_trainer):
    algorithm = make_trainer("agent=ppo_mirror_loss").algorithm
    theirs = type("Theirs", (type(algorithm),), {}), type("Theirs", (type(algorithm.symmetry),), {})
    for thing, kind in zip((algorithm, algorithm.symmetry), theirs, strict=True):
        vars(algorithm.symmetry).pop("compute_loss", None)
        own, thing.__class__ = type(thing), kind
        replace_mirror_loss(algorithm)
        assert "compute_loss" not in vars(algorithm.symmetry)
        thing.__class__ = own
    replace_mirror_loss(algorithm)
    assert "compute_loss" in vars(algorithm.symmetry)
