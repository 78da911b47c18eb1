import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.config.checking.check_robot_names import RobotNames, check_robot, names_in_mjcf

# Each key is a tuple of overrides. Each value is a part of the message, the nearest name, and the key if it differs
# from the override's key.
R = "env.robot."
WRONG: dict[str, tuple[str | None, ...]] = {
    "env.actions.wheel_vel.joint_names=[l03,r3]": ("'r3' matches nothing", "r03"),
    "+env.actions.leg_pos.offset={l01:0.1,l99:0.2}": ("'l99' matches nothing", None, "env.actions.leg_pos.offset.l99"),
    "env.robot.actuators.legs.joint_names_expr=[nothing.*]": ("'nothing.*' matches nothing", None),
    f"{R}actuators.wheels.damping={{l3:1.0}}": ("'l3' matches nothing", "l03", f"{R}actuators.wheels.damping.l3"),
    f"++{R}init_state.joint_vel={{knee:0.1}}": ("'knee' matches nothing", None, f"{R}init_state.joint_vel.knee"),
    "env.rewards.leg_joint_deviation.asset_cfg.joint_names=[l01,l1]": ("'l1' matches nothing", "l01"),
    "env.rewards.wheel_air.sensor_cfg.body_names=[l_wheel_lnk]": ("'l_wheel_lnk' matches nothing", "l_wheel_link"),
    "env.terminations.base_contact.sensor_cfg.name=contact_force": (
        "the scene has no robot or sensor 'contact_force'", "contact_forces"),
    "env.events.add_base_mass.asset_cfg.body_names=[base]": ("'base' matches nothing", "base_link"),
    "env.actions.leg_pos.preserve_order=false": (
        "the term sees l01, r01, l02, r02", None, "env.actions.leg_pos.joint_names"),
    "env.observations.policy.terms.velocity_commands.command_name=base_velcity": (
        "there is no command 'base_velcity'", "base_velocity"),
    "+env.observations.policy.terms.last_action.action_name=leg_poss": ("there is no action 'leg_poss'", "leg_pos"),
    "env.curriculum.lin_vel_z_weight.term_name=lin_vel_zz": ("there is no reward 'lin_vel_zz'", "lin_vel_z"),
    "+env.events.reset_base.pose_range.yw=[0,1]": ("unknown key 'yw'", "yaw"),
}  # fmt: skip
NAMES = RobotNames(["l1", "r1", "l2"], ["base", "left", "right"])


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def told(_own_cache: None) -> dict[str, dict[str, object]]:
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        status = main(["check", "task=stand", "--json", *WRONG])
    assert status == 2
    mistakes = json.loads(said.getvalue())["mistakes"]
    assert len(mistakes) == len(WRONG)
    return {mistake["key"]: mistake for mistake in mistakes}


@pytest.mark.parametrize("override", WRONG)
def test_a_wrong_name_is_reported_with_key_place_and_nearest_name(override, told):
    message, nearest, *other = WRONG[override]
    key = other[0] if other else override.split("=")[0].lstrip("+")
    assert message in str(told[key]["message"])
    if "preserve_order" in override:
        # The error is in the list, so the place is the line of the list in the file.
        assert str(told[key]["file"]).endswith("configs/action/leg_pos.yaml")
        assert told[key]["line"] == 4
    else:
        assert str(told[key]["override"]).replace(" ", "") == override
    if nearest is not None:
        assert told[key]["nearest"] == nearest


REFUSED = {
    "env.robot.joint_order=[l01,r01,l02,r02,l03]": "lacks r03",
    "env.robot.joint_order=[l01,l01,r01,l02,r02,l03,r03]": "names l01 more than once",
    "env.robot.joint_order=[l01,r01,l02,r02,l03,r3]": "no joint 'r3'",
    "env.robot.joint_order=[[l01]]": "no joint '['l01']'",
    "env.robot.actuators.wheels.joint_names_expr=['.*0[23]$']": "is driven by both",
    "env.robot.init_state.rot=[1,0,0]": "expected 4 finite numbers",
    "env.robot.init_state.rot=[0,0,0,0]": "not all zero",
    "env.robot.init_state.pos=[0,0]": "expected 3 finite numbers",
    "env.events.push_robot.interval_range_s=[10,5]": "expected [low, high]",
    "env.rewards.alive._target_=wheelleg_exp.mdp.terminations.time_out": "is a term of terminations",
    "env.robot.actuators.legs=null": "no actuator drives l01, r01, l02, r02",
    "run.name=a/b": "run.name: 'a/b'",
    "recording.env_ids=[600]": "from 0 to 511",
    "recording.env_ids=[1,1]": "each once",
    "agent.obs_groups.actor=[policy,policy]": "names a group twice",
    "check.silence.noop_restitution=": "has no reason",
}


def test_values_that_no_robot_manager_or_training_accepts_are_reported_with_their_places(capsys):
    waiting = dict(REFUSED)
    while waiting:  # Each command has one override of each section.
        words = list({tuple(override.split("=")[0].split(".")[:3]): override for override in waiting}.values())
        assert main(["check", "task=stand", *words]) == 2
        told = capsys.readouterr().err.splitlines()
        for override in words:
            place = "configs/action/leg_pos.yaml" if "legs=null" in override else f"override {override}"
            assert [line for line in told if place in line and waiting[override] in line], override
            del waiting[override]


def test_names_of_an_mjcf_are_breadth_first(tmp_path: Path):
    file = tmp_path / "robot.xml"
    file.write_text(
        '<mujoco><worldbody><geom type="plane"/><body name="lamp"/><body name="root"><freejoint/>'
        '<body name="l1"><joint name="jl1"/><body name="l2"><joint name="jl2"/></body></body>'
        '<body name="r1"><joint name="jr1"/></body></body></worldbody></mujoco>'
    )
    names = names_in_mjcf(file)
    assert (names.bodies, names.joints) == (["root", "l1", "r1", "l2"], ["jl1", "jr1", "jl2"])


@pytest.mark.parametrize(("names", "told"), [(["l1", "r1"], 0), (["r1", "l1"], 1), ([".*"], 0), (["l.*", "r1"], 1)])
def test_a_list_is_out_of_order_only_where_the_robot_changes_it(names, told):
    action = {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": names}
    config = {"env": {"robot": {}, "scene": {}, "actions": {"legs": action}}}
    assert len(check_robot(config, NAMES)) == told
    action["preserve_order"] = True
    assert check_robot(config, NAMES) == []


def test_a_sensor_offers_only_the_bodies_that_it_senses():
    entity = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "feet", "body_names": ["base"]}
    term = {"_target_": "wheelleg_exp.mdp.rewards.no_contact_count", "weight": 1, "threshold": 1, "sensor_cfg": entity}
    scene = {"sensors": {"feet": {"_target_": "x", "body_names": ["left", "right"]}}}
    config = {"env": {"robot": {}, "scene": scene, "rewards": {"air": term}}}
    (error,) = check_robot(config, NAMES)
    assert error.key == "env.rewards.air.sensor_cfg.body_names"
    assert "left, right" in str(error.expected)
    entity["joint_names"] = ["l1"]
    assert "has no joints" in check_robot(config, NAMES)[0].message


def test_a_camera_that_would_draw_too_many_environments_is_refused(capsys):
    camera = "+sensor@env.scene.sensors=camera"
    assert main(["check", camera, "env.num_envs=17"]) == 2
    assert "sensors.camera.max_num_envs: 17 environments" in (message := capsys.readouterr().err)
    assert "configs/sensor/camera.yaml" in message
    assert "env.num_envs at most 16" in message
    assert main(["check", camera, "env.num_envs=16"]) == 0
