"""Each number of an Isaac Lab config changes the imported config, or the report names it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from sim.terrain.tiles import placed

from tests.isaaclab_import.runs import AGENT, ENV, ROBOT, changed, write_terms
from wheelleg_exp.asset.convert_robot import read
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab.envs import mdp
from wheelleg_exp.isaaclab_import.agent_mapping import convert_agent
from wheelleg_exp.isaaclab_import.author_terms import AuthorTerms
from wheelleg_exp.isaaclab_import.env_mapping import EnvMapping
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, CODE, DROPPED, NAME, NOT_NEEDED, RULE, ImportReport
from wheelleg_exp.plain_data import tagged_yaml_value
from wheelleg_exp.terms.term_binding import resolve_target

LAB_3 = """
import warp as wp
from isaaclab.envs import mdp
from isaaclab_tasks.core.velocity.mdp import feet_slide


def pva_orientation(env):
    return env.buffer.default_root_pose


def effort(env, ids):
    robot = env.scene["robot"]
    robot.set_joint_position_target_index(target=wp.to_torch(robot.data.joint_pos))
    robot.actuators.target_command.set_velocity_index(value=robot.actuators.target_command.velocity.torch)
    lean = mdp.pva_projected_gravity(env) + robot.data.default_root_pose.torch[ids, :3] + pva_orientation(env)
    slide = feet_slide(env) + env.scene.sensors["feet"].data.net_normal_forces_w_history.torch[:, 0]
    return robot.actuators.applied_effort.torch[:, ids].sum(1) + slide
"""
MDP = "isaaclab.envs.mdp"
DOFS = {dof.name: dof for body in read(ROBOT, "auto", {})[0].bodies for dof in body.dofs}


def converted(env: Any, agent: Any, **names: str) -> tuple[EnvMapping, dict[str, Any], ImportReport]:
    """Convert a config that is given as text or as a tree."""
    report = ImportReport()
    tree = tagged_yaml_value(env) if isinstance(env, str) else env
    mapping = EnvMapping(tree, DOFS, lambda path, params: None, report, names)
    mapping.convert()
    settings = tagged_yaml_value(agent) if isinstance(agent, str) else agent
    return mapping, convert_agent(settings, list(mapping.env["observations"]), None, report), report


def numbers(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each number in a tree."""
    parts = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in parts:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield (*path, key)
        yield from numbers(value, (*path, key))


TREES = {"env": tagged_yaml_value(ENV), "agent": tagged_yaml_value(AGENT)}
# These numbers have no effect.
IGNORED = ("viewer", "intensity", "min_step_count_between_reset")  # the last acts only in events at a reset
PATHS = [(name, path) for name, tree in TREES.items() for path in numbers(tree)]


@pytest.mark.parametrize(("name", "path"), PATHS, ids=lambda value: ".".join(map(str, value)) if value else "")
def test_no_number_is_lost(name: str, path: tuple[Any, ...]) -> None:
    trees = copy.deepcopy(TREES)
    node = trees[name]
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = node[path[-1]] * 2 + 3
    before, after = converted(TREES["env"], TREES["agent"]), converted(trees["env"], trees["agent"])
    results = [(m.env, m.robot, m.seed, agent, report.rows) for m, agent, report in (before, after)]
    assert results[0] != results[1] or any(word in path for word in IGNORED) or (name, path) == ("agent", ("seed",))


def test_values() -> None:
    mapping, agent, report = converted(ENV, AGENT)
    env, robot = mapping.env, mapping.robot
    assert env["sim"] == {"dt": 0.005, "gravity": [0.0, 0.0, -9.81]}
    assert (env["decimation"], robot["friction_combine_mode"], robot["self_collisions"]) == (4, "multiply", False)
    legs, wheels = robot["actuators"]["legs"], robot["actuators"]["wheels"]
    assert legs["_target_"].endswith("DCMotor")
    expected = {"saturation_effort": 4.0, "friction": 0.01, "velocity_limit": 30.0}
    assert expected | {"stiffness": {".*01": 3.0, ".*02": 2.5}} == {key: legs[key] for key in (*expected, "stiffness")}
    assert wheels["effort_limit"] == 9.0
    limits = {name: dof.max_velocity for name, dof in DOFS.items() if name.endswith("03")}
    assert wheels["velocity_limit"] == next(iter(limits.values()))  # from the robot's file
    group = env["observations"]["policy"]
    assert list(group["terms"]) == ["base_ang_vel", "gravity", "command", "joint_pos", "joint_vel", "actions"]
    noise = group["terms"]["base_ang_vel"]["noise"]
    assert noise == {"_target_": "wheelleg_exp.mdp.noise.UniformNoise", "operation": "add", "n_min": -0.2, "n_max": 0.2}
    assert group["terms"]["joint_pos"]["asset_cfg"]["joint_names"] == [".*0[12]"]
    event = env["events"]["default_material"]
    assert (event["static_friction_range"], event["dynamic_friction_range"]) == ([0.9, 0.9], [0.8, 0.8])
    assert env["events"]["push"]["interval_range_s"] == [2.0, 3.0]
    assert "interval_range_s" not in env["events"]["reset_base"]
    assert (agent["algorithm"]["gamma"], agent["obs_groups"]["critic"]) == (0.98, ["policy"])
    assert (agent["actor"]["hidden_dims"], agent["actor"]["distribution_cfg"]["init_std"]) == ([32, 16], 0.8)
    outcomes = {row.key: row.outcome for row in report.rows}
    expected = {"rewards.own": CODE, "scene.cube": DROPPED, "scene.sky_light": NOT_NEEDED, "viewer": NOT_NEEDED}
    expected |= {"sim.physx": DROPPED, "sim.physics_material": RULE}
    expected["scene.robot.actuators.wheels.velocity_limit"] = ASSUMED
    assert {key: outcomes.get(key) for key in expected} == expected


def test_what_isaac_lab_3_writes_differently() -> None:
    robot, legs, wheels = "scene.robot", "scene.robot.actuators.legs", "scene.robot.actuators.wheels"
    saturation = {".*01": 4.0, ".*02": 5.0}
    fragments = [
        {"func": "isaaclab.sim.schemas:apply_namespaced", "enabled_self_collisions": True, "_usd_namespace": "a"},
        {"self_collision_enabled": True, "_usd_namespace": "newton"},
    ]
    gravity = {"delay_min_lag": 1, "delay_max_lag": 2, "delay_hold_prob": 0.5, "params": {}}
    gravity |= {"func": "isaaclab.envs.mdp.observations:projected_gravity", "history_length": 0}
    text = ENV
    for key, value in {
        "sim.physx": None,
        "sim.physics": {"num_substeps": 2, "solver_cfg": {"solver_type": "mujoco_warp", "iterations": 70}},
        f"{robot}.spawn.articulation_props": fragments,
        f"{robot}.spawn.fix_root_link": True,
        f"{legs}.effort_limit": None,
        f"{legs}.actuator_effort_limit": 2.5,
        f"{legs}.velocity_limit": None,
        f"{legs}.actuator_velocity_limit": 20.0,
        f"{legs}.joint_effort_limit": 2.2,
        f"{legs}.saturation_effort": saturation,
        f"{wheels}.effort_limit_sim": None,
        f"{wheels}.actuator_effort_limit": 7.0,
        f"{wheels}.joint_effort_limit": 8.0,
        "scene.contact_forces.prim_path": "{ENV_REGEX_NS}/Robot/[^/]*",
        "observations.policy.gravity": gravity,
        "events.push.resample_interval_on_reset": False,
        "rewards.air_time.func": "isaaclab_tasks.core.velocity.mdp.rewards:feet_air_time",
        "commands.base_velocity.vel_xy_success_threshold": 0.5,
        "scene.imu": {"class_type": "isaaclab.sensors:Imu", "prim_path": "{ENV_REGEX_NS}/Robot/base_link"},
        "scene.pva": {"class_type": "isaaclab.sensors:Pva", "prim_path": "{ENV_REGEX_NS}/Robot/base_link"},
        "observations.policy.tilt": {"func": "isaaclab.envs.mdp:pva_projected_gravity", "params": {}},
        "observations.policy.turn": {"func": "isaaclab.envs.mdp:pva_orientation", "params": {}},
        f"{robot}.actuators.rated": {
            **{"class_type": "isaaclab.actuators:ImplicitActuator", "joint_names_expr": ["l03"]},
            **{"stiffness": 0.0, "damping": 1.0, "actuator_effort_limit": 6.0},
        },
    }.items():
        text = changed(text, key, value)
    mapping, _, report = converted(text, AGENT)
    found, env = mapping.robot, mapping.env
    assert (found["init_state"]["rot"], found["base"]) == ([0.0, 1.0, 0.0, 0.0], "fixed")
    assert (env["sim"]["iterations"], found["self_collisions"]) == (70, True)
    drives = found["actuators"]["legs"]
    assert set(drives["effort_limit"].values()) == {2.2}
    assert (drives["velocity_limit"], drives["saturation_effort"]) == (20.0, saturation)
    assert found["actuators"]["wheels"]["effort_limit"] == 8.0
    assert env["scene"]["sensors"]["contact_forces"]["body_names"] == ["[^/]*"]
    assert found["actuators"]["rated"]["effort_limit"] == 6.0
    assert [env["scene"]["sensors"][n]["gravity_bias"] for n in ("imu", "pva")] == [[0, 0, 9.81], [0, 0, 0]]
    terms = env["observations"]["policy"]["terms"]
    assert (terms["gravity"]["delay"], "turn" in terms, list(mapping.lost)) == ([4, 8], False, ["policy"])
    assert terms["tilt"]["_target_"].endswith("observations.imu_projected_gravity")
    assert env["rewards"]["air_time"]["_target_"].endswith(".feet_air_time")
    rows = {row.key: row.text for row in report.of(DROPPED)}
    assert "sim.physics.num_substeps" in rows
    assert "(x, y, z, w)" in rows["observations.policy.turn"]
    assert "0.5" in rows["observations.policy.gravity.delay_hold_prob"]
    assert "resample_interval_on_reset" in rows["events.push"]
    assert "7.0" in rows["scene.robot.actuators.wheels.actuator_effort_limit"]
    assert not [row for row in report.rows if "success_threshold" in row.key + row.text]


def test_other_names() -> None:
    text = ENV.replace("[lr]01", "(left|right)_hip").replace("'[lr]02'", "left_knee: -1.885, right_knee")
    mapping, _, _ = converted(text, AGENT, left_hip="l01", right_hip="r01", left_knee="l02", right_knee="r02")
    pose = mapping.robot["init_state"]["joint_pos"]
    assert pose == {"l01": 0.9599, "r01": 0.9599, "l02": -1.885, "r02": -1.885, ".*03": 0.0}


def with_terrain(generator: dict[str, Any]) -> str:
    text = changed(ENV, "scene.terrain.terrain_type", "generator")
    return changed(text, "scene.terrain.terrain_generator", generator)


def test_terrain_tiles() -> None:
    tiles = {
        "slope": {"function": "isaaclab.terrains.height_field.hf_terrains:pyramid_sloped_terrain", "proportion": 0.5,
                  "slope_range": [0.0, 0.4], "platform_width": 2.0, "inverted": False, "border_width": 0.25},
        "pit": {"function": "isaaclab.terrains.trimesh.mesh_terrains:pit_terrain", "proportion": 0.2,
                "pit_depth_range": [0.05, 0.2], "platform_width": 1.0, "double_pit": True},
        "star": {"function": "isaaclab.terrains.trimesh.mesh_terrains:star_terrain", "proportion": 0.3},
    }  # fmt: skip
    generator = {"size": [8.0, 8.0], "num_rows": 10, "num_cols": 20, "curriculum": True, "sub_terrains": tiles}
    mapping, _, report = converted(with_terrain(generator), AGENT)
    made = mapping.env["scene"]["terrain"]["sub_terrains"]
    assert made["slope"]["slope_range"] == pytest.approx([0.0, 0.3805063771])  # atan(0.4)
    assert [made["pit"][key] for key in ("box_height_range", "inverted", "double_box")] == [[0.05, 0.2], True, True]
    assert [row.key.rsplit(".", 1)[-1] for row in report.of(DROPPED) if "star" in row.key] == ["star"]


@pytest.mark.parametrize(("width", "border", "shift"), [(3.0, 1.0, 0), (2.2, 0.4, 0), (3.0, 0.2, 1), (3.0, 0.0, 1)])
@pytest.mark.parametrize("sign", [1, -1])
def test_stairs_are_as_high_as_isaac_labs(sign: int, width: float, border: float, shift: int) -> None:
    function = f"{'inverted_' if sign < 0 else ''}pyramid_stairs_terrain"
    tile = {"function": f"isaaclab.terrains.trimesh.mesh_terrains:{function}", "proportion": 1.0}
    tile |= {"step_height_range": [0.1, 0.2], "step_width": 0.3, "platform_width": width, "border_width": border}
    mapping, _, report = converted(with_terrain({"size": [8.0, 8.0], "sub_terrains": {"stairs": tile}}), AGENT)
    node = mapping.env["scene"]["terrain"]["sub_terrains"]["stairs"]
    made = resolve_target(node.pop("_target_"), "")(**node)
    ground = placed({"stairs": made}, size=[8.0, 8.0], num_rows=1, num_cols=1, difficulty_range=[1.0, 1.0])
    # Isaac Lab's ring number k, counted from the border, has the height (k + 1) h; the middle has that of one more.
    rings = int((8 - 2 * border - width) // 0.6) + 1
    x = torch.arange(0.05, 8.0, 0.1)
    to_border = torch.minimum(torch.minimum(x, 8 - x)[:, None], torch.minimum(x, 8 - x)[None]) - border
    expected = torch.where(to_border < 0, 0, ((to_border / 0.3).floor() + 1).clamp(max=rings + 1) - shift)
    points = torch.stack(torch.meshgrid(x - 4, x - 4, indexing="ij"), dim=-1)
    torch.testing.assert_close(ground.height_at(points), sign * 0.2 * expected, atol=1e-4, rtol=0)
    assert ["same heights" in row.text for row in report.of(RULE) if "PyramidStairs" in row.text] == [shift == 0]


def test_notes_on_stairs() -> None:
    tile = {"step_height_range": [0.1, 0.2], "step_width": 0.3, "platform_width": 3.0, "border_width": 1.0}
    tile |= {"function": "isaaclab.terrains.trimesh.mesh_terrains:pyramid_stairs_terrain"}
    high = {"function": "isaaclab.terrains.height_field.hf_terrains:pyramid_stairs_terrain", "inverted": True}
    tiles = {"fine": tile | {"step_width": 0.25}, "full": tile | {"platform_width": 0.0}, "high": tile | high}
    mapping, _, report = converted(with_terrain({"size": [8.0, 8.0], "sub_terrains": tiles}), AGENT)
    rows = {row.key.rsplit(".", 1)[-1]: row for row in report.rows if "sub_terrains." in row.key}
    notes = ["edges are rounded" in rows["fine"].text, "the middle is at least a step lower" in rows["full"].text]
    assert (notes, rows["high"].outcome) == ([True, True], NAME)
    made = mapping.env["scene"]["terrain"]["sub_terrains"]["high"]
    assert [made[key] for key in ("platform_width", "border_width", "inverted")] == [3.0, 1.0, True]


def test_names_outside_isaac_lab_are_assumed() -> None:
    tiles = {"box": {"function": "my_lab.tiles:box_terrain", "box_height_range": [0.1, 0.2], "platform_width": 1.0}}
    text = with_terrain({"size": [8.0, 8.0], "sub_terrains": tiles})
    text = changed(text, "observations.policy.base_ang_vel.noise.func", "my_lab.noise:uniform_noise")
    text = changed(
        text, "observations.policy.phase", {"func": f"{MDP}.observations:gait_phase", "params": {"period": 1}}
    )
    report = converted(text, AGENT)[2]
    rows = {row.key: row.text for row in report.of(ASSUMED)}
    assert rows["scene.terrain.terrain_generator.sub_terrains.box"].startswith("my_lab.tiles:box_terrain")
    assert "observations.policy.base_ang_vel.noise" in rows
    assert "Sines, then cosines" in rows["observations.policy.phase"]
    assert not [row for row in report.rows if row.key in rows and row.outcome == NAME]


def test_an_authors_term_with_a_name_of_isaac_lab_needs_code() -> None:
    own = {"func": "my_lab.mdp:clip", "params": {}}
    text = changed(changed(ENV, "observations.policy.flag", 5), "observations.policy.own", own)
    mapping, _, report = converted(changed(text, "rewards.own_clip", own | {"weight": 1.0}), AGENT)
    assert (mapping.lost["policy"].key, mapping.lost["policy"].outcome) == ("observations.policy.own", CODE)
    assert [row.outcome for row in report.rows if row.text.startswith("my_lab.mdp:clip")] == [CODE, CODE]


def test_objects_behind_sensors_and_markers_are_reported() -> None:
    paths = ["/World/envs/env_.*/Cube/.*", "/World/envs/env_.*/Robot/base_link", "/World/ground/terrain"]
    text = changed(ENV, "scene.contact_forces.filter_prim_paths_expr", paths)
    text = changed(text, "scene.cube_contact", {"class_type": "isaaclab.sensors:ContactSensor", "prim_path": paths[0]})
    arrows = {"prim_path": "/Visuals/arrows", "markers": {"arrow": {"func": "isaaclab.sim:spawn_from_usd"}}}
    text = changed(changed(text, "scene.arrows", arrows), "rewards.own.params.marker_cfg", arrows)
    mapping, _, report = converted(text, AGENT)
    sensors = mapping.env["scene"]["sensors"]
    assert (list(sensors), sensors["contact_forces"]["filter_body_names"]) == (
        ["contact_forces"],
        ["base_link", "ground"],
    )
    dropped = {row.key: row.text for row in report.of(DROPPED)}
    assert dropped["scene.contact_forces.filter_prim_paths_expr"].startswith("/World/envs/env_.*/Cube/.*:")
    assert dropped["scene.cube_contact"].startswith("a ContactSensor:")
    markers = [row.key for row in report.of(NOT_NEEDED) if row.text.startswith("markers")]
    places = ["scene.arrows", "rewards.own.params.marker_cfg", "commands.base_velocity.goal_vel_visualizer_cfg"]
    assert sorted(markers) == sorted(places)


@pytest.mark.parametrize(
    ("path", "found"),
    [
        ("{ENV_REGEX_NS}/.*/base_link", True),
        ("/World/envs/.*/Robot/base_link", True),
        ("{ENV_REGEX_NS}/Robot.*/base_link", True),
        ("{ENV_REGEX_NS}/[Rr]obot/base_link", True),
        ("/World/groundPlane", True),
        ("{ENV_REGEX_NS}/Robot_2/base_link", False),
        ("/World/envs/env_.*", False),
    ],
)
def test_a_sensor_whose_path_matches_the_robot_exists(path: str, found: bool) -> None:
    mapping, _, _ = converted(changed(ENV, "scene.contact_forces.prim_path", path), AGENT)
    assert ("contact_forces" in mapping.env["scene"]["sensors"]) is found


def test_limits_of_explicit_actuators_are_also_those_of_the_engine() -> None:
    legs = "scene.robot.actuators.legs"
    text = changed(changed(ENV, f"{legs}.effort_limit_sim", {".*01": 1.0, ".*02": 5.0}), f"{legs}.velocity_limit", None)
    node = converted(changed(text, f"{legs}.velocity_limit_sim", 12.0), AGENT)[0].robot["actuators"]["legs"]
    assert node["effort_limit"] == {"l01": 1.0, "l02": 2.0, "r01": 1.0, "r02": 2.0}
    assert node["velocity_limit"] == 12.0


def test_the_ground_plane_has_its_own_friction() -> None:
    material = {"static_friction": 0.3, "dynamic_friction": 0.2, "friction_combine_mode": "max"}
    spawn = {"func": "isaaclab.sim.spawners.from_files.from_files:spawn_ground_plane", "physics_material": material}
    text = changed(changed(ENV, "scene.terrain", None), "scene.ground", {"class_type": None, "spawn": spawn})
    mapping, _, _ = converted(text, AGENT)
    terrain = mapping.env["scene"]["terrain"]
    assert (terrain["static_friction"], terrain["dynamic_friction"]) == (0.3, 0.2)
    assert mapping.robot["friction_combine_mode"] == "max"


@pytest.mark.parametrize(("fix_root_link", "base"), [(None, "fixed"), (False, "floating")])
def test_the_base_is_fixed_by_the_converter_or_the_articulation(fix_root_link: bool | None, base: str) -> None:
    tree = copy.deepcopy(TREES["env"])
    spawn = tree["scene"]["robot"]["spawn"]
    spawn |= {"fix_base": True, "articulation_props": {"fix_root_link": fix_root_link}}
    assert converted(tree, AGENT)[0].robot["base"] == base


def test_names_that_are_not_listed_stay() -> None:
    mapping, _, _ = converted(
        ENV.replace("joint_names_expr: .*03", "joint_names_expr: '.*3'"), AGENT, left_wheel_3="l03"
    )
    assert mapping.robot["actuators"]["wheels"]["joint_names_expr"] == ["l03", ".*3"]
    with pytest.raises(ConfigError, match="no joint or link 'x03'"):
        converted(ENV, AGENT, left_wheel="x03")


def test_the_logarithm_of_the_deviation() -> None:
    agent = converted(ENV, AGENT.replace("init_noise_std: 0.8", "init_noise_std: 0.8\n  noise_std_type: log"))[1]
    assert agent["actor"]["distribution_cfg"]["std_type"] == "log"


def test_a_group_without_history_overrides_its_terms() -> None:
    text = changed(ENV, "observations.policy.base_ang_vel.history_length", 5)
    terms = converted(text, AGENT)[0].env["observations"]["policy"]["terms"]
    assert terms["base_ang_vel"]["history_length"] == 5
    mapping, _, _ = converted(changed(text, "observations.policy.history_length", 0), AGENT)
    assert "history_length" not in mapping.env["observations"]["policy"]["terms"]["base_ang_vel"]


@pytest.mark.parametrize("key", ["decimation", "scene.robot", "episode_length_s"])
def test_missing_parts(key: str) -> None:
    with pytest.raises(ConfigError):
        converted(changed(ENV, key, None), AGENT)


def test_recorders() -> None:
    path = "isaaclab.envs.mdp.recorders.recorders:"
    settings = {"dataset_filename": "dataset", "dataset_export_mode": {"_value_": 1}, "export_in_close": True}
    terms = {"start": {"class_type": f"{path}InitialStateRecorder"}, "own": {"class_type": "my_lab:Recorder"}}
    mapping, _, report = converted(changed(ENV, "recorders", settings | terms), AGENT)
    assert mapping.env["recorders"] == {"start": {"_target_": "wheelleg_exp.mdp.recorders.InitialStateRecorder"}}
    assert [row.key for row in report.of(CODE) if row.key.startswith("recorders")] == ["recorders.own"]
    assert [row.key for row in report.of(NOT_NEEDED) if row.key.startswith("recorders")] == [
        f"recorders.{name}" for name in settings
    ]


def test_author_terms(tmp_path: Path) -> None:
    terms = AuthorTerms(write_terms(tmp_path), "mine")
    assert terms.target("my_lab.tasks.mdp.rewards:tilt_cost") == "mine.rewards.tilt_cost"
    assert terms.target("my_lab.tasks.mdp.rewards:absent") is None
    modules = terms.modules()
    assert set(modules) == {"rewards", "helpers"}
    lines = ["FACTOR = 0.5", "from wheelleg_exp.isaaclab.managers import SceneEntityCfg"]
    lines += ["from mine.helpers import squared as power_two"]
    assert all(line in modules["rewards"] for line in lines)
    assert not any(name in modules["rewards"] for name in ("unused", "pandas"))


def test_author_terms_of_isaac_lab_3(tmp_path: Path) -> None:
    (tmp_path / "rewards.py").write_text(LAB_3)
    author = AuthorTerms(tmp_path, "new", version_3=True)
    assert author.target("lab.rewards:effort") == "new.rewards.effort"
    text = author.modules()["rewards"]
    assert "data.applied_torque[:, ids].sum(1)" in text
    assert "data.net_forces_w_history)" not in text
    assert "env.scene.sensors['feet'].data.net_forces_w_history[:, 0]" in text
    assert "robot.set_joint_position_target(target=robot.data.joint_pos)" in text
    assert "robot.set_joint_velocity_target(target=robot.data.joint_vel_target)" in text
    assert "mdp.pva_projected_gravity(env) + robot.data.default_root_state[:, :7][ids, :3] + pva_or" in text
    assert "def pva_orientation(env):\n    return env.buffer.default_root_pose" in text
    assert "from wheelleg_exp.isaaclab.envs import mdp" in text
    assert mdp.pva_projected_gravity is mdp.imu_projected_gravity
    assert "from wheelleg_exp.isaaclab_tasks.core.velocity.mdp import feet_slide" in text
