"""Import run folders completely: play, train further, and refuse broken folders without leaving files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from sim.actuators import torques

from tests.isaaclab_import.runs import AGENT, ENV, ROBOT, ActorCritic, Exported, changed, write_run, write_terms
from tests.isaaclab_import.test_author_runners import LIMX, TRON2, write_network
from wheelleg_exp.build import build_env
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.isaaclab_import import make_project
from wheelleg_exp.isaaclab_import.import_report import CODE
from wheelleg_exp.isaaclab_import.make_project import import_run
from wheelleg_exp.rl import checkpoint as checkpoints
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.actuators import network_actuators


def test_an_imported_run_plays_and_trains_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, policy = write_run(tmp_path / "run", ENV.replace("'.*03': 0.0", "left_wheel: 0.0"))
    write_terms(tmp_path / "lab")
    (tmp_path / "names.yaml").write_text("left_wheel: l03\n")
    monkeypatch.chdir(tmp_path)
    words = ["import", "run", "--robot", str(ROBOT), "--terms", "lab", "--names", "names.yaml", "--output", "flip0"]
    assert main([*words, "--policy", "run/model_700.pt"]) == 0
    printed = capsys.readouterr().out
    assert "needs code" not in printed
    assert "dropped: scene.cube" in printed
    assert "next: cd flip0" in printed
    project = tmp_path / "flip0"
    run = RunDirectory.open("latest", project / "runs")
    state = checkpoints.load(run.latest_checkpoint())
    torch.testing.assert_close(state["actor_state_dict"]["mlp.0.weight"], policy.actor[0].weight.detach())
    torch.testing.assert_close(state["critic_state_dict"]["mlp.4.bias"], policy.critic[4].bias.detach())
    saved = torch.load(folder / "model_700.pt", weights_only=True)["optimizer_state_dict"]["state"]
    moments = state["optimizer_state_dict"]["state"]
    assert len(moments) == len(saved) == 13
    torch.testing.assert_close(moments[5]["exp_avg"], saved[5]["exp_avg"])
    monkeypatch.chdir(project)
    exported = torch.jit.load(run.exported / "policy.pt")
    x = torch.randn(5, 25)
    torch.testing.assert_close(exported(x), policy.actor(x), atol=1e-5, rtol=1e-5)
    words = ["play", str(run.path), "env.episode_length_s=0.4", "env.num_envs=2"]
    assert main(words) == 0
    assert "no pushes, random forces, or observation noise" in capsys.readouterr().err
    assert main(["resume", str(run.path), "agent.max_iterations=2"]) == 0
    assert main(["check", "task=flip0"]) == 0
    text = (project / "README.md").read_text()
    assert "rigid_object" not in text
    assert "scene.cube" in text
    assert "{{" not in text


def test_the_answer_as_json_lists_every_row_of_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "run", ENV)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(make_project, "call_limited", lambda importing, **_: importing())
    assert main(["import", "run", "--robot", str(ROBOT), "-o", "flip1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["project"] == "flip1"
    assert not Path(found["run"]).is_absolute()
    assert RunDirectory.open(found["run"], "nowhere").latest_checkpoint().is_file()
    rows = [row for row in found["report"] if row["key"] == "scene.cube"]
    assert [row["outcome"] for row in rows] == ["dropped"]
    assert all(row["key"] in (tmp_path / "flip1" / "README.md").read_text() for row in found["report"])


def built(project: Path, *words: str) -> ManagerBasedRLEnv:
    composed = compose(words, config_dirs=[project / "configs"])
    env = build_env(composed.config, composed.asset_roots)
    env.reset()
    return env


def test_observations_are_isaac_labs(tmp_path: Path) -> None:
    folder, _ = write_run(tmp_path / "run", ENV.replace("enable_corruption: true", "enable_corruption: false"))
    made = import_run(folder, ROBOT, tmp_path / "flip2")
    env = built(made.path, "task=flip2", "env.num_envs=3", "env.rewards.air_time=null")
    for _ in range(7):
        actions = torch.rand(3, 6) - 0.5
        found = env.step(actions)[0]["policy"]
    data, command = env.scene.robot.data, env.command_manager.get_command("base_velocity")
    names = env.scene.robot.joint_names
    legs = [index for index, name in enumerate(names) if not name.endswith("03")]
    default = torch.tensor([{"01": 0.9599, "02": -1.885, "03": 0.0}[name[1:]] for name in names])
    w, x, y, z = data.root_quat_w.unbind(-1)
    gravity = torch.stack((2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1), -1)
    joints = ((data.joint_pos - default)[:, legs], 0.05 * data.joint_vel)
    parts = (0.25 * data.root_ang_vel_b, gravity, command, *joints, actions)
    torch.testing.assert_close(found, torch.cat(parts, -1), atol=1e-5, rtol=1e-5)
    assert names == ["l01", "r01", "l02", "r02", "l03", "r03"]


def test_the_exported_order_of_joints(tmp_path: Path) -> None:
    folder, _ = write_run(tmp_path / "run", changed(ENV, "scene.robot.sizes", {"asset": "/etc/passwd", "size": 9.0}))
    order = ["r03", "l01", "r01", "l02", "r02", "l03"]
    (folder / "io_descriptors").mkdir()
    described = {"articulations": {"robot": {"joint_names": order}}, "actions": [], "observations": {}}
    (folder / "io_descriptors/IO_descriptors.yaml").write_text(yaml.safe_dump(described))
    made = import_run(folder, ROBOT, tmp_path / "flip4")
    robot = yaml.safe_load((made.path / "configs/robot/flip4.yaml").read_text())
    assert robot["joint_order"] == order
    assert (robot["asset"], robot.get("size")) == ("flip4/wheelleg.usda", None)


def test_a_term_that_fails_when_it_is_called_needs_code(tmp_path: Path) -> None:
    failing = {"func": "my_lab.tasks.mdp.rewards:failing", "params": {}, "weight": 1.0}
    folder, _ = write_run(tmp_path / "run", changed(ENV, "rewards.failing", failing))
    terms = write_terms(tmp_path / "lab")
    (terms / "latin.py").write_bytes(b"# \xe9")
    made = import_run(folder, ROBOT, tmp_path / "flip5", terms=terms)
    assert [row.key for row in made.report.of(CODE)] == ["rewards.failing"]
    assert made.what == "learning"


def test_without_a_policy(tmp_path: Path) -> None:
    folder, _ = write_run(tmp_path / "run")
    (folder / "model_700.pt").unlink()
    made = import_run(folder / "params/env.yaml", ROBOT, tmp_path / "flip3")
    assert made.run is None
    assert [row.key for row in made.report.of(CODE)] == ["rewards.own"]


UNITREE = {
    "joint_ids_map": [0, 3, 1, 4, 2, 5],
    "step_dt": 0.02,
    "stiffness": [3.0, 3.0, 0.0, 3.0, 3.0, 0.0],
    "damping": [0.3, 0.3, 1.0, 0.3, 0.3, 1.0],
    "default_joint_pos": [0.9599, 0.9599, -1.885, -1.885, 0.0, 0.0],
    "commands": {"base_velocity": {"ranges": {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [0, 0], "ang_vel_z": [-1, 1]}}},
    "actions": {
        "JointPositionAction": {"scale": [0.25] * 6, "offset": [0.9599, 0.9599, -1.885, -1.885, 0.0, 0.0]},
    },
    "observations": {
        "base_ang_vel": {"params": {}, "clip": None, "scale": [0.2, 0.2, 0.2], "history_length": 2},
        "velocity_commands": {"params": {"command_name": "base_velocity"}, "scale": [1.0] * 3, "history_length": 2},
        "last_action": {"params": {}, "scale": [1.0] * 6, "history_length": 1},
    },
}  # fmt: skip
GYM = UNITREE | {
    "commands": None,
    "actions": {
        "JointPositionAction": {"scale": [0.25] * 4, "offset": [0.9599] * 2 + [-1.885] * 2, "joint_ids": [0, 1, 2, 3]},
    },
    "observations": {
        "obs": {
            "use_gym_history": True,
            "scale_first": True,
            "base_ang_vel": {"params": {}, "clip": [-0.02, 0.02], "scale": [0.2, 0.2, 0.2], "history_length": 2},
            "last_action": {"params": {}, "history_length": 2},
        },
        "depth": {"depth_image": {"params": {}}},
    },
}  # fmt: skip
RL_SAR = {
    "flip/robot_lab": {
        "joint_mapping": [0, 1, 2, 3, 4, 5],
        "wheel_indices": [4, 5],
        "dt": 0.005,
        "decimation": 4,
        "observations": ["ang_vel", "gravity_vec", "commands", "dof_pos", "dof_vel", "actions"],
        "observations_history": [1, 0],
        "observations_history_priority": "time",
        "clip_obs": 100.0,
        "clip_actions_lower": [-100.0] * 6,
        "clip_actions_upper": [100.0] * 6,
        "rl_kp": [3.0, 3.0, 3.0, 3.0, 0.0, 0.0],
        "rl_kd": [0.3, 0.3, 0.3, 0.3, 1.0, 1.0],
        "torque_limits": [2.0, 2.0, 2.0, 2.0, 9.0, 9.0],
        "action_scale": [0.125, 0.25, 0.125, 0.25, 5.0, 5.0],
        "ang_vel_scale": 0.25,
        "dof_pos_scale": 1.0,
        "dof_vel_scale": 0.05,
        "commands_scale": [1.0, 1.0, 1.0],
        "default_dof_pos": [0.9599, -1.885, 0.9599, -1.885, 0.0, 0.0],
    }
}


@pytest.mark.parametrize(("file", "content", "width"), [("deploy.yaml", UNITREE, 18), ("config.yaml", RL_SAR, 54)])
def test_deployment_folders(
    tmp_path: Path, file: str, content: dict[str, object], width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "deploy/legged/walk"
    folder.mkdir(parents=True)
    if file == "config.yaml":  # rl_sar's base.yaml can be two folders above.
        base = {"flip": {"joint_names": ["r01", "r02", "l01", "l02", "r03", "l03"]}}
        (tmp_path / "deploy/base.yaml").write_text(yaml.safe_dump(base))
    (folder / file).write_text(yaml.safe_dump(content, sort_keys=False))
    torch.jit.script(Exported(ActorCritic(width).actor, torch.nn.Identity())).save(str(folder / "policy.pt"))
    name = f"flip_{file.split('.')[0]}"
    (folder / "encoder.onnx").write_text("of another policy")  # Only LimX's policies have an encoder.
    monkeypatch.chdir(folder)
    made = import_run(Path(), ROBOT, tmp_path / name)
    assert made.run is not None
    env = built(made.path, f"task={name}", "env.num_envs=2")
    actions = torch.tensor([[0.3, -0.2, 0.1, 0.4, 0.5, -0.6]]).repeat(2, 1)
    found = env.step(actions)[0]["policy"]
    assert env.step_dt == 0.02
    written = env.options.robot
    sizes = [written.size, written.mass, written.wheel_radius, written.standing_height]
    assert sizes == pytest.approx([0.07, 0.5, 0.02, 0.07], rel=0.02)
    data, robot = env.scene.robot.data, env.scene.robot
    if file == "deploy.yaml":
        assert robot.joint_names == ["l01", "r01", "l02", "r02", "l03", "r03"]
        torch.testing.assert_close(found[:, 3:6], 0.2 * data.root_ang_vel_b, atol=1e-5, rtol=1e-5)
        expected = torch.tensor([0.9599, 0.9599, -1.885, -1.885, 0.0, 0.0]) + 0.25 * actions
        torch.testing.assert_close(data.joint_pos_target, expected, atol=1e-5, rtol=1e-5)
    else:
        assert robot.joint_names == ["r01", "r02", "l01", "l02", "r03", "l03"]
        assert {name: drive.joint_names for name, drive in robot.actuators.items()}["wheels"] == ["r03", "l03"]
        now = found[:, 27:]
        legs = data.joint_pos - torch.tensor([0.9599, -1.885, 0.9599, -1.885, 0.0, 0.0])
        torch.testing.assert_close(now[:, 9:13], legs[:, :4], atol=1e-5, rtol=1e-5)
        assert (now[:, 13:15] == 0).all()  # rl_sar sets the angles of wheels to 0
        torch.testing.assert_close(now[:, 15:21], 0.05 * data.joint_vel, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(data.joint_vel_target[:, 4:], 5.0 * actions[:, 4:], atol=1e-5, rtol=1e-5)


def test_a_deployment_folder_with_named_groups_and_successive_steps(tmp_path: Path) -> None:
    (tmp_path / "deploy.yaml").write_text(yaml.safe_dump(GYM, sort_keys=False))
    torch.jit.script(Exported(ActorCritic(14, 4).actor, torch.nn.Identity())).save(str(tmp_path / "policy.pt"))
    env = built(import_run(tmp_path, ROBOT, tmp_path / "flip_gym").path, "task=flip_gym", "env.num_envs=2")
    actions = [torch.full((2, 4), value) for value in (2.0, -1.0)]
    turning = []
    for action in actions:
        found = env.step(action)[0]["policy"]
        turning.append((0.2 * env.scene.robot.data.root_ang_vel_b).clamp(-0.02, 0.02))
    assert (turning[1].abs() == 0.02).any()  # clipped after the scale
    torch.testing.assert_close(found, torch.cat((turning[0], actions[0], turning[1], actions[1]), 1))
    held = torch.tensor([0.9599, 0.9599, -1.885, -1.885, 0.0, 0.0])
    held[:4] += 0.25 * actions[1][0]
    torch.testing.assert_close(env.scene.robot.data.joint_pos_target[0], held)


def _replace(file: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_text(text) and None


def _edit(key: str, value: object) -> Callable[[Path], None]:
    return _replace("params/env.yaml", changed(ENV, key, value))


def _state(**entries: object) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        state = torch.load(folder / "model_700.pt", weights_only=True)
        torch.save(state | entries, folder / "model_700.pt")

    return write


def _evil(folder: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (folder.parent / "executed",)

    torch.save({"model_state_dict": Evil()}, folder / "model_700.pt")


RAYS = {"class_type": "isaaclab.sensors:RayCaster", "pattern_cfg": {"func": "x:y"}}
SECRET = {"func": "lab.mdp:secret", "params": {}}
SYSTEM = {"func": "os:system", "params": {"command": "touch executed"}, "weight": 1.0}
TAG = "seed: !!python/object/apply:os.system ['touch executed']"


def _with_nan(folder: Path) -> None:
    networks = torch.load(folder / "model_700.pt", weights_only=True)["model_state_dict"]
    _state(model_state_dict={name: value * float("nan") for name, value in networks.items()})(folder)


def _link(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _limx(folder: Path) -> None:
    (folder / "params/env.yaml").rename(folder / "params.yaml")


LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
WIDE = {"func": "isaaclab.envs.mdp.observations:joint_pos_rel", "params": {}}
OTHER = "actor: {distribution_cfg: {class_name: HeteroscedasticGaussianDistribution}}\n"
BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (lambda f: shutil.rmtree(f), "does not exist"),
    "no env.yaml": (lambda f: (f / "params/env.yaml").unlink(), "contains no run"),
    "no YAML": (_replace("params/env.yaml", "a: [1"), "cannot be read"),
    "binary env.yaml": (lambda f: (f / "params/env.yaml").write_bytes(b"\x00\xff\xfe"), "cannot be read"),
    "LFS env.yaml": (_replace("params/env.yaml", LFS), "Git LFS"),
    "LFS policy": (lambda f: (f / "model_700.pt").write_text(LFS), "Git LFS"),
    "repeated key": (_replace("params/env.yaml", ENV + "\nseed: 3\n"), "repeated"),
    "billion laughs": (_replace("params/env.yaml", "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9))), "too many nodes"),
    "deep": (_replace("params/env.yaml", "a: " + "[" * 300 + "]" * 300), "nested too deeply"),
    "huge integer": (_replace("params/env.yaml", ENV.replace("seed: 42", "seed: 1" + "0" * 400)), "too large"),
    "negative step": (_edit("sim.dt", -0.005), "dt"),
    "no scene": (_edit("scene", None), "no articulation"),
    "actuator is text": (_edit("scene.robot.actuators.legs", "all"), "legs: .*mapping"),
    "rotation of 2 numbers": (_edit("scene.robot.init_state.rot", [1.0, 0.0]), "rot"),
    "pattern of rays": (_edit("scene.rays", RAYS), "pattern"),
    "second robot": (_edit("scene.other", {"class_type": "isaaclab.assets:Articulation"}), "two robots"),
    "other joints": (_edit("actions.legs.joint_names", ["FL_hip"]), "FL_hip"),
    "no command": (_edit("commands.base_velocity", None), "no command 'base_velocity'"),
    "own observation": (_edit("observations.policy.x", SECRET), "observations.policy.x"),
    "own clip": (_edit("observations.policy.x", {"func": "lab.mdp:clip", "params": {}}), "observations.policy.x"),
    "hostile target": (_edit("rewards.x", SYSTEM), ""),
    "hostile parameter": (_edit("rewards.track.params.std", {"_target_": "os.system", "command": "x"}), "std"),
    "hostile tag": (_replace("params/env.yaml", ENV.replace("seed: 42", TAG)), "seed"),
    "pose outside limits": (_edit("scene.robot.init_state.joint_pos", {".*01": 50.0}), "outside its limits"),
    "wider observations": (_edit("observations.policy.more", WIDE), "the policy has 25 observations"),
    "pickle": (_evil, "cannot be read"),
    "another network": (_state(model_state_dict={"estimator.0.weight": torch.ones(1, 1)}), "another network"),
    "NaN": (_with_nan, "NaN"),
    "variable": (_edit("scene.robot.spawn.usd_path", "${oc.env:HOME}"), "spawn.usd_path: .*'\\$\\{'"),
    "many steps": (_edit("decimation", 1_000_000_000), "decimation: .*at most 10000"),
    "many lines": (_replace("params/env.yaml", ENV + "#" * (15 << 20)), "more than 1 MiB"),
    "expression": (_edit("actions.legs.joint_names", ["(a|a)" * 30]), "too many ways"),
    "half lags": (_edit("observations.policy.gravity.delay_max_lag", 2.5), "delay_max_lag: .*whole numbers"),
    "other distribution": (_replace("params/agent.yaml", AGENT + OTHER), "distribution_cfg.class_name"),
    "another params.yaml": (_limx, "params.yaml: .*structure .KeyError: 'PointfootCfg'"),
    "empty policy": (lambda f: (f / "model_700.pt").write_bytes(b""), "damaged"),
    "ONNX policy.pt": (lambda f: write_network(f / "model_700.pt", [25, 8, 6]), "damaged"),
    "link to itself": (lambda f: _link(f / "params/env.yaml"), "contains no run"),
    "bad agent": (_replace("params/agent.yaml", AGENT.replace("gamma: 0.98", "gamma: 3.0")), "gamma"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_broken_folders(tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder, _ = write_run(tmp_path / "run")
    change, words = BROKEN[case]
    change(folder)
    before = sorted(tmp_path.iterdir())
    if case == "hostile target":  # The run is imported without the author's function.
        import_run(folder, ROBOT, tmp_path / "flip")
    else:
        with pytest.raises(WheellegError, match=words) as error:
            import_run(folder, ROBOT, tmp_path / "flip")
        assert "\n" not in str(error.value) or str(error.value).startswith("3 mistakes in the config:")
        assert ".tmp" not in str(error.value)
        assert sorted(tmp_path.iterdir()) == before
    assert not (tmp_path / "executed").exists()


FLIP = {"flip": RL_SAR["flip/robot_lab"] | {"joint_names": ["r01", "r02", "l01", "l02", "r03", "l03"]}}
SPOILED = {
    "deploy.yaml": {
        **{"step_dt": float("nan"), "stiffness": [3.0], "default_joint_pos": "x", "joint_ids_map": [-1, 0, 1, 2, 3, 4]},
        **{"observations": {}, "actions": {}, "commands": [1], "damping": [-1.0] * 6},
        **{"observations.base_ang_vel.history_length": -1, "observations.last_action.scale": [float("inf")] * 6},
        **{"actions.JointPositionAction.joint_ids": [-1] * 6, "actions.JointPositionAction.scale": [float("nan")] * 6},
        **{"commands.base_velocity.ranges.lin_vel_x": [float("nan")] * 2},
    },
    "config.yaml": {
        **{"flip.dt": 0.0, "flip.decimation": 0, "flip.wheel_indices": [-1], "flip.joint_mapping": [0, 0, 0, 0, 0, 0]},
        **{"flip.observations": ["os.system"], "flip.action_scale": None, "flip": {}},
        **{"flip.default_dof_pos": [1e400] * 6, "flip.joint_names": ["x"] * 6, "flip.model_name": "../../etc/passwd"},
        **{"flip.rl_kp": [-3.0] * 6, "flip.observations_history": [-1, -2], "flip.dof_pos_scale": {}},
    },
    "params.yaml": {
        **{"PointfootCfg.loop_frequency": 0, "PointfootCfg.joint_names": [], "PointfootCfg": 3},
        **{"PointfootCfg.size.jointpos_idxs": [0, -1], "PointfootCfg.control.decimation": "ten"},
        **{"PointfootCfg.size.obs_history_length": 10**9, "PointfootCfg.normalization.obs_scales.lin_vel": 0.0},
        **{"Tron2Cfg": TRON2 | {"gait": {"enabled": True}}},
    },
}  # fmt: skip
GOOD = {"deploy.yaml": UNITREE, "config.yaml": FLIP, "params.yaml": {"PointfootCfg": LIMX}}
CASES = [(file, key, value) for file, edits in SPOILED.items() for key, value in edits.items()]


@pytest.mark.parametrize(("file", "key", "value"), CASES)
def test_spoiled_deployment_folders_are_refused_in_one_sentence(
    tmp_path: Path, file: str, key: str, value: object
) -> None:
    (tmp_path / "deploy").mkdir()
    (tmp_path / "deploy" / file).write_text(changed(yaml.safe_dump(GOOD[file]), key, value))
    with pytest.raises(WheellegError, match=rf"({file}|env\.).*; expected ") as error:
        import_run(tmp_path / "deploy", ROBOT, tmp_path / "flip")
    assert str(error.value).count("\n") <= 6
    assert not (tmp_path / "flip").exists()


NETWORKS = {
    "ActuatorNetMLP": {
        **{"pos_scale": -1.0, "vel_scale": 1.0, "torque_scale": 1.0, "input_order": "pos_vel"},
        **{"input_idx": [0, 1, 2], "effort_limit": 2.0, "velocity_limit": 30.0, "saturation_effort": 4.0},
    },
    "ActuatorNetLSTM": {"effort_limit": 2.0, "velocity_limit": 30.0, "saturation_effort": 4.0},
}


@pytest.mark.parametrize("kind", NETWORKS)
def test_an_actuator_network_is_imported_and_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    legs = {"class_type": f"isaaclab.actuators.actuator_net:{kind}", "joint_names_expr": [".*0[12]"], **NETWORKS[kind]}
    legs["network_file"] = "https://server/Isaac/ActuatorNets/legs.pt"
    folder, _ = write_run(tmp_path / "run", changed(ENV, "scene.robot.actuators.legs", legs))
    torques.written(torques.perceptron() if kind == "ActuatorNetMLP" else torques.recurrent(), folder / "legs.pt")
    monkeypatch.setattr(network_actuators, "call_limited", lambda load, *words, **_: load(*words))
    made = import_run(folder, ROBOT, tmp_path / "flip8")
    node = yaml.safe_load((made.path / "configs/robot/flip8.yaml").read_text())["actuators"]["legs"]
    assert (made.path / "assets" / node["network_file"]).read_bytes() == (folder / "legs.pt").read_bytes()
    monkeypatch.chdir(made.path)
    assert main(["play", "latest", "env.episode_length_s=0.4", "env.num_envs=2"]) == 0


@pytest.mark.parametrize("status", [0, pytest.param(3, marks=pytest.mark.full)])
def test_a_term_cannot_end_the_import(tmp_path: Path, status: int, capsys: pytest.CaptureFixture[str]) -> None:
    term = {"func": "my_lab.tasks.mdp.rewards:leaving", "params": {}, "weight": 1.0}
    write_run(tmp_path / "run", changed(ENV, "rewards.leaving", term))
    (write_terms(tmp_path / "lab") / "leave.py").write_text(
        f"import os\n\n\ndef leaving(env):\n    os._exit({status})\n"
    )
    before = sorted(tmp_path.iterdir())
    words = ["import", tmp_path / "run", "--robot", ROBOT, "--terms", tmp_path / "lab", "-o", tmp_path / "flip9"]
    assert main([str(word) for word in words]) == 2
    assert f"with status {status}" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_the_readme_has_no_escape_codes(tmp_path: Path) -> None:
    folder, _ = write_run(tmp_path / "run", changed(ENV, "scene.\x1b[31mcube", {"class_type": "x:\x1b]0;title\x07y"}))
    made = import_run(folder, ROBOT, tmp_path / "flip")
    text = (made.path / "README.md").read_text()
    assert "cube" in text
    assert text.replace("\n", "").isprintable()
