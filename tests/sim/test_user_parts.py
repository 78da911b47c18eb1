import inspect

import mujoco
import pytest
import torch

from sim.small_envs import run
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.actuators import IdealPDActuator
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.sensors import LazySensor, PatternBase, SensorBase
from wheelleg_exp.sim.terrain import TerrainBase

pytestmark = pytest.mark.usefixtures("allow_test_terms")
HERE = "sim.test_user_parts."
GROUP = {"joint_names_expr": [".*"], "stiffness": 1.0, "damping": 0.1, "effort_limit": 1.0, "velocity_limit": 9.0}
GROUND = {"static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0}


def fails(self, *_):
    raise RuntimeError("no signal")


RaisesInMeasure = type("RaisesInMeasure", (SensorBase,), {"measure": fails})
RaisesInConnect = type("RaisesInConnect", (SensorBase,), {"connect": fails})
RaisesWhenRead = type("RaisesWhenRead", (LazySensor,), {"sense": fails})
RaisesInRays = type("RaisesInRays", (PatternBase,), {"rays": fails})
RaisesInAddTo = type("RaisesInAddTo", (TerrainBase,), {"add_to": fails})
RaisesInControl = type("RaisesInControl", (IdealPDActuator,), {"control": fails})
RaisesInReset = type("RaisesInReset", (IdealPDActuator,), {"reset": fails})


class Fast(BatchEngine):
    @classmethod
    def from_config(cls, model, num_envs, sim, robot, /, *, times):
        made = super().from_config(model, num_envs, sim, robot)
        made.times = times
        return made

    def step(self):
        for _ in range(self.times):
            super().step()


class NoMeasure(SensorBase):
    pass


class NoSuper(SensorBase):
    def add_to(self, spec, name, robot):
        pass


class NoSuperInConnect(SensorBase):
    def connect(self, sim, stream):
        pass


class TwoSizes(PatternBase):
    def rays(self, device):
        return torch.zeros(4, 3), torch.ones(5, 3)


class NoLength(PatternBase):
    def rays(self, device):
        return torch.zeros(2, 3), torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])


class StartsAlone(PatternBase):
    def rays(self, device):
        return torch.zeros(4, 3)


class NoGround(TerrainBase):
    def add_to(self, spec):
        pass


class Floor(TerrainBase):
    name = "floor"

    def add_to(self, spec):
        spec.worldbody.add_geom(name=self.name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])


class FlatOrigins(Floor):
    name = "ground"

    def origins(self, num_envs, spacing, device):
        return torch.zeros(num_envs, 2)


class OwnCollisions(Floor):
    name = "ground"

    def add_to(self, spec):
        super().add_to(spec)
        for geom in spec.geoms:  # The geoms of the robot collide with the ground only.
            is_floor = geom.name == self.name
            geom.contype, geom.conaffinity = (4, 0) if is_floor else (0, 4)


class OneHeight(Floor):
    name = "ground/1"

    def height_at(self, xy):
        return torch.zeros(7)


class OneJoint(IdealPDActuator):
    def control(self, targets, data):
        return super().control(targets, data)[:, :1]


def line_of(name, method, below=0):
    own = globals()[name]
    return f"test_user_parts.py:{inspect.getsourcelines(vars(own).get(method, own))[1] + below}"


SENSOR, TERRAIN, DRIVE = "env.scene.sensors.mine", "env.scene.terrain", "env.robot.actuators.hips"
RAYS = f"{SENSOR}.pattern"
ROWS = [
    (SENSOR, "NoMeasure", SimulationFailure, "must define the method 'measure(due, elapsed)'", ("", 0)),
    (SENSOR, "RaisesInMeasure", SimulationFailure, "RuntimeError: no signal", ("measure", 1)),
    (SENSOR, "RaisesInConnect", ConfigError, "RuntimeError: no signal", ("connect", 1)),
    (SENSOR, "NoSuper", ConfigError, "expected super().add_to(spec, name, robot) in it", ("add_to", 0)),
    (SENSOR, "NoSuperInConnect", ConfigError, "expected super().connect(sim, stream) in it", ("connect", 0)),
    (RAYS, "TwoSizes", ConfigError, "returns shapes (4, 3) and (5, 3)", ("rays", 0)),
    (RAYS, "NoLength", ConfigError, "a direction of length 0", ("rays", 0)),
    (RAYS, "StartsAlone", ConfigError, "returns a tensor of shape (4, 3)", ("rays", 0)),
    (RAYS, "RaisesInRays", ConfigError, "RuntimeError: no signal", ("rays", 1)),
    (TERRAIN, "NoGround", ConfigError, "adds no geom", ("add_to", 0)),
    (TERRAIN, "Floor", ConfigError, "adds a geom named 'floor'", ("add_to", 0)),
    (TERRAIN, "FlatOrigins", ConfigError, "returns a tensor of shape (4, 2)", ("origins", 0)),
    (TERRAIN, "OneHeight", ConfigError, "returns a tensor of shape (7,)", ("height_at", 0)),
    (TERRAIN, "RaisesInAddTo", ConfigError, "RuntimeError: no signal", ("add_to", 1)),
    (DRIVE, "OneJoint", ConfigError, "returns a tensor of shape (4, 1)", ("control", 0)),
    (DRIVE, "RaisesInControl", SimulationFailure, "RuntimeError: no signal", ("control", 1)),
    (DRIVE, "RaisesInReset", SimulationFailure, "RuntimeError: no signal", ("reset", 1)),
]


@pytest.mark.parametrize(("key", "name", "kind", "said", "line"), ROWS)
def test_a_wrong_part_is_named_with_its_key_file_and_line(start_env, key, name, kind, said, line):
    node = {"_target_": HERE + name}
    caster = {"_target_": "wheelleg_exp.sim.sensors.RayCaster", "body_name": "base", "pattern": node}
    changes = {
        SENSOR: {"scene": {"sensors": {"mine": node}}},
        RAYS: {"scene": {"sensors": {"mine": caster}}},
        TERRAIN: {"scene": {"terrain": node | GROUND}},
        DRIVE: {"robot": {"actuators": {"hips": node | GROUP}}},
    }
    with pytest.raises(kind) as raised:
        run(start_env(**changes[key]))
    text = str(raised.value)
    assert text.startswith(f"{key}: '{HERE}{name}")
    assert "\n" not in text
    assert said in text
    assert line_of(name, *line) in text


def test_an_error_in_a_lazy_sensor_names_the_sensor(make_env):
    env = make_env(scene={"sensors": {"mine": {"_target_": HERE + "RaisesWhenRead"}}})
    with pytest.raises(SimulationFailure, match=f"{SENSOR}: '{HERE}RaisesWhenRead.*RuntimeError: no signal"):
        env.scene["mine"].data  # noqa: B018


def test_a_ground_can_choose_what_collides_even_if_the_robot_does_not_collide_with_itself(make_env):
    ground = {"_target_": HERE + "OwnCollisions"} | GROUND
    model = make_env(scene={"terrain": ground}, robot={"self_collisions": False}).scene.model
    found = {model.geom(g).name: (model.geom_contype[g], model.geom_conaffinity[g]) for g in range(model.ngeom)}
    assert found.pop("ground") == (4, 0)
    assert set(found.values()) == {(0, 4)}


def test_an_engine_is_chosen_by_its_class_and_takes_the_keys_of_its_node(make_env):
    own = make_env(sim={"engine": {"_target_": HERE + "Fast", "times": 2}}).scene.sim
    stock = make_env().scene.sim
    own.step()
    stock.step()
    assert not torch.equal(own.view("qpos"), stock.view("qpos"))
    stock.step()
    assert torch.equal(own.view("qpos"), stock.view("qpos"))
    with pytest.raises(ConfigError, match="'NoMeasure' is not an Engine"):
        make_env(sim={"engine": {"_target_": HERE + "NoMeasure"}})
