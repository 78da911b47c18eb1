"""Noise models and modifiers, compared with closed forms."""

import numpy as np
import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.manager_base import build
from wheelleg_exp.mdp import modifiers, noise

T = torch.tensor


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("operation", "expected"), [("add", 5.0), ("scale", 6.0), ("abs", 2.0)])
def test_constant_noise(operation, expected):
    assert noise.ConstantNoise(2.0, operation)(torch.full((2, 2), 3.0), gen()).tolist() == [[expected] * 2] * 2


def test_uniform_noise_lies_between_its_bounds():
    drawn = noise.UniformNoise(-0.5, 1.5)(torch.full((4000, 2), 10.0), gen())
    assert 9.5 <= float(drawn.min()) < 9.51
    assert 11.49 < float(drawn.max()) <= 11.5
    assert float(drawn.mean()) == pytest.approx(10.5, abs=0.03)
    assert abs(float(torch.corrcoef(drawn.T)[0, 1])) < 0.05


def test_gaussian_noise_has_its_mean_and_deviation():
    drawn = noise.GaussianNoise(1.0, 0.5, "scale")(torch.full((20000, 1), 4.0), gen())
    assert (float(drawn.mean()), float(drawn.std())) == (pytest.approx(4.0, abs=0.05), pytest.approx(2.0, abs=0.05))


N = "wheelleg_exp.mdp.noise."
KINDS = ("Constant", "Uniform", "Gaussian")


def _bias(operation="abs"):
    node = {"_target_": N + "NoiseModelWithAdditiveBias", "noise_cfg": {"_target_": N + "ConstantNoise"}}
    return node | {"bias_noise_cfg": {"_target_": N + "UniformNoise", "operation": operation}}


@pytest.mark.parametrize(
    ("node", "message"),
    [
        *(
            ({"_target_": f"{N}{kind}Noise", "operation": "ad"}, r"operation: 'ad'.*did you mean 'add'")
            for kind in KINDS
        ),
        *((_bias(operation), r"bias_noise_cfg\.operation: .*expected abs") for operation in ("add", "scale")),
    ],
)
def test_unknown_operations_and_biases_that_would_add_up_are_rejected(node, message):
    with pytest.raises(ConfigError, match=r"noise\." + message):
        build(node, "noise")


def test_a_bias_stays_between_resets_and_is_fresh_after_one():
    model, generator = build(_bias(), "noise"), gen()
    zero = torch.zeros(3, 2)
    first = model(zero, generator).clone()
    assert torch.equal(model(zero, generator), first)
    assert len(first.unique()) == 6  # per component
    seen = []
    for _ in range(300):
        model.reset(T([1]), generator)
        seen.append(model(zero, generator).clone())
    stacked = torch.stack(seen)
    assert torch.equal(stacked[:, 0], first[0].expand(300, 2))
    assert stacked[:, 1].abs().max() <= 1.0  # no random walk
    assert len(stacked[:, 1].unique()) > 590


def test_a_bias_can_be_one_for_all_components():
    generator = gen()
    model = noise.NoiseModelWithAdditiveBias(noise.ConstantNoise(), noise.UniformNoise(operation="abs"), False)
    first = model(torch.zeros(3, 4), generator).clone()
    assert torch.equal(first, first[:, :1].expand(3, 4))
    assert len(first[:, 0].unique()) == 3
    model.reset(T([1]), generator)
    later = model(torch.ones(3, 4), generator) - 1.0
    torch.testing.assert_close(later[[0, 2]], first[[0, 2]])
    assert (later[1] != first[1]).all()
    assert (later[1] == later[1, 0]).all()
    picture = noise.NoiseModelWithAdditiveBias(noise.ConstantNoise(), noise.UniformNoise(operation="abs"), False)
    assert len(picture(torch.zeros(3, 4, 5, 2), generator).unique()) == 3


def test_a_bias_is_added_to_the_noise():
    model = noise.NoiseModelWithAdditiveBias(noise.ConstantNoise(10.0), noise.ConstantNoise(0.5, "abs"))
    assert model(T([[1.0]]), gen()).item() == 11.5


def test_a_bias_drawn_in_inference_mode_can_be_redrawn_outside():
    model, generator = build(_bias(), "noise"), gen()
    with torch.inference_mode():
        model(torch.zeros(2, 2), generator)
    before = model.state_dict()["_bias"]
    model.reset(T([0]), generator)
    after = model.state_dict()["_bias"]
    assert not torch.equal(after[0], before[0])
    assert torch.equal(after[1], before[1])


def _run(modifier, series, width=1):
    values = T(series, dtype=torch.float32).view(-1, 1, 1).expand(-1, 2, width)
    modifier.start(values[0])
    return [modifier(v)[0, 0].item() for v in values]


def test_a_filter_is_its_difference_equation():
    feedback, forward = [0.5, -0.25], [1.0, 2.0, 0.5]
    series = [1.0, 0.0, -2.0, 3.0, 1.0, 1.0]
    x, y = [0.0, 0.0, *series], [0.0, 0.0]
    for i in range(2, len(x)):
        y.append(x[i] + 2 * x[i - 1] + 0.5 * x[i - 2] - 0.5 * y[-1] + 0.25 * y[-2])
    assert _run(modifiers.DigitalFilter(feedback, forward), series) == pytest.approx(y[2:])


def test_an_integral_is_the_trapezoidal_rule():
    x = np.sin(np.arange(20) / 3)
    expected = [np.trapezoid(np.concatenate(([0.0], x[: k + 1])), dx=0.1) for k in range(20)]
    assert _run(modifiers.Integrator(0.1), x.tolist()) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("modifier", [modifiers.DigitalFilter([0.5], [1.0, 1.0]), modifiers.Integrator(0.1)])
def test_a_reset_forgets_only_its_environments(modifier):
    start = torch.ones(2, 1)
    modifier.start(start)
    fresh = modifier(start).clone()
    modifier(start)
    modifier.reset(T([1]))
    after = modifier(start)
    assert after[1] == fresh[1]
    assert after[0] != fresh[0]


@pytest.mark.parametrize(
    ("modifier", "series", "expected"),
    [
        (modifiers.Scale(3.0), [2.0], [6.0]),
        (modifiers.Bias(3.0), [2.0], [5.0]),
        (modifiers.Clip([-1.0, 1.0]), [2.0, -3.0, 0.5], [1.0, -1.0, 0.5]),
        (modifiers.DigitalFilter([], [0.5, 0.5]), [2.0, 4.0, 8.0], [1.0, 3.0, 6.0]),
    ],
)
def test_a_modifier_by_hand(modifier, series, expected):
    assert _run(modifier, series) == expected


def test_the_coefficients_of_a_filter_are_config_and_not_state():
    first, second = modifiers.DigitalFilter([0.5], [1.0, 1.0]), modifiers.DigitalFilter([0.0], [2.0, 0.0])
    for f in (first, second):
        f.start(torch.ones(1, 1))
    second.load_state_dict(first.state_dict())
    assert second(torch.ones(1, 1)).item() == 2.0


def errors(steps=1, seed=0, value=0.0, shape=(4000, 2), **parameters):
    """Return the readings of a sensor that measures a constant, (steps, ...)."""
    model, generator = noise.SensorErrors(**parameters), gen(seed)
    return torch.stack([model(torch.full(shape, value), generator) for _ in range(steps)])


def test_a_sensors_noise_and_drift_have_their_deviations():
    assert float(errors(std=0.3).std()) == pytest.approx(0.3, rel=0.03)
    walk = errors(steps=25, drift=0.1)
    assert float(walk[24].std()) == pytest.approx(0.1 * 25**0.5, rel=0.03)
    assert float((walk[24] - walk[23]).std()) == pytest.approx(0.1, rel=0.03)


def test_a_sensors_readings_are_multiples_of_its_resolution():
    readings = errors(std=0.3, resolution=0.25) / 0.25
    assert torch.equal(readings, readings.round())
    assert len(readings.unique()) > 5


def test_a_lost_reading_repeats_the_last_one_for_all_components_of_a_robot():
    readings = errors(steps=200, std=1.0, lost=0.25, shape=(100, 3))
    repeats = readings[1:] == readings[:-1]
    assert torch.equal(repeats.all(dim=2), repeats.any(dim=2))
    assert float(repeats.float().mean()) == pytest.approx(0.25, abs=0.01)


def test_a_lagging_sensor_approaches_a_step_like_a_first_order_filter():
    model, generator = noise.SensorErrors(lag=4.0), gen()
    model(torch.zeros(1000, 1), generator)
    once = model(torch.ones(1000, 1), generator)
    constant = 1.0 / once - 1.0  # once = 1 / (1 + T)
    assert 0.0 <= float(constant.min()) < 0.1
    assert 3.9 < float(constant.max()) <= 4.0
    twice = model(torch.ones(1000, 1), generator)
    torch.testing.assert_close(twice, once + (1.0 - once) / (1.0 + constant))


def test_a_reset_starts_a_new_walk_and_filter_in_its_environments_only():
    odd_and_even = {}
    for settings in ({"drift": 0.1}, {"lag": 5.0}):
        model, generator = noise.SensorErrors(**settings), gen()
        for _ in range(99):
            model(torch.zeros(2000, 1), generator)
        model.reset(torch.arange(1, 2000, 2), generator)
        readings = model(torch.ones(2000, 1), generator)
        odd_and_even |= {name: (readings[1::2], readings[::2]) for name in settings}
    walks = [float(readings.std()) for readings in odd_and_even["drift"]]
    assert walks == pytest.approx([0.1, 0.1 * 100**0.5], rel=0.1)  # The walk has 1 step or 100.
    once, later = odd_and_even["lag"]
    assert (once == 1.0).all()
    assert float(later.mean()) == pytest.approx(np.log(6.0) / 5.0, rel=0.1)  # the mean of 1 / (1 + T)
