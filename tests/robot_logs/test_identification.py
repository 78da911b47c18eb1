"""Six parameters of each motor are found from chirps, with intervals that contain them, and written as a profile."""

import json
import math

import numpy as np
import pytest
import yaml
from jobs.small import refused, succeed

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.robot_logs.motor_identification import PARAMETERS

from .made import bundle_of, chirp
from .test_robot_log import write_csv

MASS, RADIUS = 0.05, 0.015


def with_weights(scene: str) -> str:
    """Add a weight below the axle of each wheel; the thigh and the shank turn the wheel's frame about y."""
    angle = 0.9599 - 1.885
    place = f"{RADIUS * math.sin(angle)} 0 {-RADIUS * math.cos(angle)}"
    geom = f'<geom type="sphere" size=".0001" mass="{MASS}" contype="0" conaffinity="0"/>'
    for joint in ("l03", "r03"):
        scene = scene.replace(f'<joint name="{joint}"', f'<body pos="{place}">{geom}</body><joint name="{joint}"')
    return scene


@pytest.mark.slow
def test_six_parameters_of_each_motor_are_found_within_5_percent(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bundle").mkdir()
    bundle, _, _ = bundle_of("physical", tmp_path / "bundle")
    spec, rng = json.loads((bundle / "policy.json").read_text()), np.random.default_rng(1)
    limits = {"armature": (0.7, 1.4), "friction": (0.01, 0.03), "viscous_friction": (0.05, 0.2)}
    of = {"armature": "armature", "friction": "effort_limit", "viscous_friction": "damping"}
    truth = {key: np.array(spec[of[key]]) * rng.uniform(*bounds, 6) for key, bounds in limits.items()}
    truth |= {"gain": rng.uniform(0.8, 1.2, 6), "delay": rng.uniform(0.008, 0.025, 6)}
    truth["effort_scale"] = rng.uniform(0.8, 1.2, 6)
    log = write_csv(tmp_path / "chirps.csv", chirp(bundle, truth, with_weights))
    weights = [word for joint in ("l03", "r03") for word in ("--weight", f"{joint}={MASS},{RADIUS}")]
    found = json.loads(succeed("identify", log, "--robot", "physical", "--output", "mine.yaml", *weights, "--json").out)
    assert len(found["parameters"]) == 6 * len(PARAMETERS)
    inside = 0
    for one in found["parameters"]:
        true = truth[one["name"]][spec["joint_names"].index(one["joint"])]
        assert one["value"] == pytest.approx(true, rel=0.05), one
        inside += one["low"] <= true <= one["high"]
    assert inside >= 0.9 * len(found["parameters"])
    before, after = found["held_out"]
    assert after < 1.5 < before
    legs = compose(["robot=mine"], config_dirs=[_config_folder(tmp_path)]).config["env"]["robot"]["actuators"]["legs"]
    assert legs["armature"]["l01"] == pytest.approx(truth["armature"][0], rel=0.05)
    assert legs["delay"] == [1, 3]


def _config_folder(folder):
    (folder / "configs" / "robot").mkdir(parents=True)
    text = (folder / "mine.yaml").read_text()
    assert yaml.safe_load(text)["profile"] == "mine"
    (folder / "configs" / "robot" / "mine.yaml").write_text(text)
    return folder / "configs"


def test_wrong_input_is_refused(tmp_path, monkeypatch, clean):
    monkeypatch.chdir(tmp_path)
    log = write_csv(tmp_path / "log.csv", clean)
    assert "no chirps" in refused("identify", log, "--robot", "physical")
    holes = {
        name: np.where(np.arange(len(clean["time"])) == 7, np.nan, clean[name]) for name in ("projected_gravity.z",)
    }
    text = refused("identify", write_csv(tmp_path / "holes.csv", clean | holes), "--robot", "physical")
    assert "no chirps that start at rest; 'projected_gravity.z' has no number in row 7" in text
    assert "holes.csv contains no checksums" in text
    assert "--weight" in refused("identify", log, "--robot", "physical", "--weight", "l03=heavy")
    assert "name of a profile" in refused("identify", log, "--robot", "physical", "-o", "x.txt")
    assert "physicl" in refused("identify", log, "--robot", "physicl", "--config-dir", tmp_path)
