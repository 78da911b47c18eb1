import copy

import pytest
import torch

from wheelleg_exp.build import build_env
from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.explaining.catalog import options

DRAWN = ("camera",)
NAMES = [
    pytest.param(entry.name, marks=pytest.mark.pictures) if entry.name in DRAWN else entry.name
    for entry in options("sensor")
]


@pytest.mark.parametrize("name", NAMES)
def test_it_measures_finite_numbers_and_continues_from_its_state(name, request):
    if name in DRAWN:
        request.getfixturevalue("graphics")
    config = compose_valid(["task=stand", "env.num_envs=2", f"+sensor@env.scene.sensors={name}"]).config
    env, other = (build_env(copy.deepcopy(config)) for _ in range(2))
    other.reset()
    env.reset()
    for _ in range(3):
        env.step(torch.zeros(2, env.action_manager.total_action_dim))
    other.load_state_dict(env.state_dict())
    found, again = (tensors(e.scene[name].data) for e in (env, other))
    assert found
    assert found.keys() == again.keys()
    for key, value in found.items():
        assert value.shape[0] == 2, key
        assert torch.equal(value, again[key]), key
        assert not value.isnan().any(), key


def tensors(data):
    found = {name: value for name, value in vars(data).items() if isinstance(value, torch.Tensor)}
    return found | {name: v for name, v in getattr(data, "output", {}).items()}
