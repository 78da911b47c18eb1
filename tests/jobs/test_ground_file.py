"""A run directory stores the terrain file, so the original file is not needed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from jobs.small import TINY, only_run, refused, succeed, wheelleg

SCENE = """# @package env.scene
defaults: [flat, _self_]
terrain:
  _target_: wheelleg_exp.sim.terrain.HeightField
  file: grounds/hills.npy
  size: [4.0, 4.0]
  height_range: null
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "configs" / "scene").mkdir(parents=True)
    (tmp_path / "configs" / "scene" / "hills.yaml").write_text(SCENE)
    (tmp_path / "assets" / "grounds").mkdir(parents=True)
    np.save(tmp_path / "assets" / "grounds" / "hills.npy", np.random.default_rng(0).uniform(0, 0.002, (41, 41)))
    return tmp_path


@pytest.mark.train
@pytest.mark.usefixtures("forks")
def test_a_run_is_resumed_played_and_replayed_on_its_stored_ground(project):
    ground = project / "assets" / "grounds" / "hills.npy"
    words = ("--config-dir", project / "configs", "scene=hills", *TINY, f"run.root={project / 'runs'}")
    words = (*words, "recording.enabled=false", "agent.logger=null")
    succeed("train", *words, "agent.max_iterations=1")
    run = only_run(project / "runs")
    kept = run / "asset" / "ground" / "grounds" / "hills.npy"
    assert kept.read_bytes() == ground.read_bytes()
    sources = json.loads((run / "asset" / "asset.json").read_text())["sources"]
    assert sources["ground/grounds/hills.npy"] == hashlib.sha256(kept.read_bytes()).hexdigest()

    ground.unlink()
    assert wheelleg("resume", run, "agent.max_iterations=2").status == 0
    assert wheelleg("play", run, "env.episode_length_s=0.2", "recording.enabled=false").status == 0
    assert "identical" in succeed("replay", run).out


def test_a_ground_that_is_not_there_is_found_by_the_check(project):
    words = ("--config-dir", project / "configs", "scene=hills", "env.scene.terrain.file=grounds/hlils.npy")
    said = refused("check", *words)
    assert [word for word in ("env.scene.terrain.file", "did you mean 'grounds/hills.npy'?") if word not in said] == []
