"""Sensors, grounds, actuators and patterns of a user's own: whatever is wrong in them is told by key, file and line."""

from __future__ import annotations

import inspect

import mujoco
import pytest
import torch

from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.actuators import IdealPDActuator
from wheelleg_exp.sim.sensors import LazySensor, PatternBase, SensorBase
from wheelleg_exp.sim.terrain import TerrainBase

pytestmark = pytest.mark.usefixtures("allow_test_terms")
HERE = "sim.test_user_parts."
GROUP = {"joint_names_expr": [".*"], "stiffness": 1.0, "damping": 0.1, "effort_limit": 1.0, "velocity_limit": 9.0}
GROUND = {"static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0}


class NoMeasure(SensorBase):
    pass


class RaisesInMeasure(SensorBase):
    def measure(self, due, elapsed):
        raise RuntimeError("no signal")


class RaisesInConnect(SensorBase):
    def connect(self, sim, stream):
        raise RuntimeError("no plug")


class NoSuper(SensorBase):
    def add_to(self, spec, name, robot):
        pass


class NoSuperInConnect(SensorBase):
    def connect(self, sim, stream):
        pass


class RaisesWhenRead(LazySensor):
    def sense(self, ids):
        raise RuntimeError("no light")


class TwoSizes(PatternBase):
    def rays(self, device):
        return torch.zeros(4, 3), torch.ones(5, 3)


class NoLength(PatternBase):
    def rays(self, device):
        return torch.zeros(2, 3), torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])


class StartsAlone(PatternBase):
    def rays(self, device):
        return torch.zeros(4, 3)


class RaisesInRays(PatternBase):
    def rays(self, device):
        raise RuntimeError("no rays")


class NoGround(TerrainBase):
    def add_to(self, spec):
        pass


class Floor(TerrainBase):
    name = "floor"

    def add_to(self, spec):
        spec.worldbody.add_geom(name=self.name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])


class Nameless(Floor):
    name = ""


class FlatOrigins(Floor):
    name = "ground"

    def origins(self, num_envs, spacing, device):
        return torch.zeros(num_envs, 2)


class OneHeight(Floor):
    name = "ground/1"

    def height_at(self, xy):
        return torch.zeros(7)


class RaisesInAddTo(TerrainBase):
    def add_to(self, spec):
        raise RuntimeError("no stones")


class OneJoint(IdealPDActuator):
    def control(self, targets, data):
        return super().control(targets, data)[:, :1]


class OneEnvironment(IdealPDActuator):
    def control(self, targets, data):
        return super().control(targets, data)[0]


class RaisesInControl(IdealPDActuator):
    def control(self, targets, data):
        raise RuntimeError("no current")


class RaisesInReset(IdealPDActuator):
    def reset(self, env_ids):
        raise RuntimeError("no reset")


def line_of(name, method):
    """Return file and line of a method's definition, or of the class where it has none."""
    own = globals()[name]
    return f"test_user_parts.py:{inspect.getsourcelines(vars(own).get(method, own))[1]}"


def stepped(make_env, **changes):
    """Build an environment, and take one step."""
    env = make_env(**changes)
    env.reset()
    env.step(torch.zeros(4, 4))


def told(raised, key, name):
    """Hold an error against its key and its code's name, and return it as one line."""
    text = str(raised.value)
    assert text.startswith(f"{key}: '{HERE}{name}")
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("name", "kind", "said", "line"),
    [
        ("NoMeasure", SimulationFailure, "needs 'measure(due, elapsed)'", 0),
        ("RaisesInMeasure", SimulationFailure, "RuntimeError: no signal", ("measure", 1)),
        ("RaisesInConnect", ConfigError, "RuntimeError: no plug", ("connect", 1)),
        ("NoSuper", ConfigError, "expected super().add_to(spec, name, robot) in it", ("add_to", 0)),
        ("NoSuperInConnect", ConfigError, "expected super().connect(sim, stream) in it", ("connect", 0)),
    ],
)
def test_a_sensor(make_env, name, kind, said, line):
    with pytest.raises(kind) as raised:
        stepped(make_env, scene={"sensors": {"mine": {"_target_": HERE + name}}})
    text = told(raised, "env.scene.sensors.mine", name)
    assert said in text
    method, below = line or ("", 0)
    file, number = line_of(name, method).split(":")
    assert f"{file}:{int(number) + below})" in text


def test_a_lazy_sensor_is_to_blame_for_what_a_term_reads(make_env):
    env = make_env(scene={"sensors": {"mine": {"_target_": HERE + "RaisesWhenRead"}}})
    with pytest.raises(SimulationFailure) as raised:
        env.scene["mine"].data  # noqa: B018
    assert "RuntimeError: no light" in told(raised, "env.scene.sensors.mine", "RaisesWhenRead")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("TwoSizes", "returns shapes (4, 3) and (5, 3)"),
        ("NoLength", "a direction of length 0"),
        ("StartsAlone", "returns a tensor of shape (4, 3)"),
        ("RaisesInRays", "RuntimeError: no rays"),
    ],
)
def test_a_pattern_of_rays(make_env, name, said):
    caster = {
        "_target_": "wheelleg_exp.sim.sensors.RayCaster",
        "body_name": "base",
        "pattern": {"_target_": HERE + name},
    }
    with pytest.raises(ConfigError) as raised:
        make_env(scene={"sensors": {"mine": caster}})
    text = told(raised, "env.scene.sensors.mine.pattern", name)
    assert said in text
    assert "test_user_parts.py:" in text


@pytest.mark.parametrize(
    ("name", "method", "said"),
    [
        ("NoGround", "add_to", "adds no geom"),
        ("Floor", "add_to", "adds a geom named 'floor'"),
        ("Nameless", None, "adds a geom named ''"),
        ("FlatOrigins", "origins", "returns a tensor of shape (4, 2)"),
        ("OneHeight", "height_at", "returns a tensor of shape (7,)"),
        ("RaisesInAddTo", None, "RuntimeError: no stones"),
    ],
)
def test_a_ground(make_env, name, method, said):
    with pytest.raises(ConfigError) as raised:
        make_env(scene={"terrain": {"_target_": HERE + name, **GROUND}})
    text = told(raised, "env.scene.terrain", name)
    assert said in text
    assert "test_user_parts.py:" in text
    assert method is None or line_of(name, method) in text


@pytest.mark.parametrize(
    ("name", "kind", "said"),
    [
        ("OneJoint", ConfigError, "returns a tensor of shape (4, 1)"),
        ("OneEnvironment", ConfigError, "returns a tensor of shape (4,)"),
        ("RaisesInControl", SimulationFailure, "RuntimeError: no current"),
        ("RaisesInReset", SimulationFailure, "RuntimeError: no reset"),
    ],
)
def test_an_actuator(make_env, name, kind, said):
    with pytest.raises(kind) as raised:
        stepped(make_env, robot={"actuators": {"hips": {"_target_": HERE + name, **GROUP}}})
    text = told(raised, "env.robot.actuators.hips", name)
    assert said in text
    assert "test_user_parts.py:" in text
