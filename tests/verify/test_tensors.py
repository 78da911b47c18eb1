import math

import pytest
import torch

from wheelleg_exp.verify.tensor_differences import count_leaves, relative_distance, tree_differences

NAN = float("nan")
INF = float("inf")


def differences(a, b):
    return list(tree_differences(a, b))


def one(a, b):
    (found,) = differences(a, b)
    return found


@pytest.mark.parametrize(
    "tree",
    [
        {"x": torch.tensor([1.0, NAN, -0.0, INF]), "n": [1, (2.0, "t")], "nothing": None},
        {"b": torch.tensor([True, False]), "i": torch.tensor(3), "e": torch.zeros(0, 2)},
        {"h": torch.zeros(2).bfloat16()},
        {"f": NAN, "z": -0.0},
    ],
)  # fmt: skip
def test_equal_bits_are_equal_nan_and_all(tree):
    copy = {key: value.clone() if isinstance(value, torch.Tensor) else value for key, value in tree.items()}
    assert differences(tree, copy) == []


def test_the_largest_difference_is_reported_with_its_place_and_size():
    a = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype=torch.float64)
    found = one(a, torch.tensor([[1.0, 2.5, 3.0], [4.0, 5.0, 4.0]], dtype=torch.float64))
    assert (found.index, found.a, found.b, found.largest) == ((1, 2), 6.0, 4.0, 2.0)
    assert (found.relative, found.count, found.of) == (pytest.approx(1 / 3), 2, 6)


@pytest.mark.parametrize(("a", "b"), [(0.0, -0.0), (NAN, -NAN)])
def test_other_bits_of_the_same_value_are_a_difference_of_size_zero(a, b):
    ones, others = torch.tensor([1.0, a]), torch.tensor([1.0, b])
    if math.isnan(a):
        others = ones.clone()
        others.view(torch.int32)[1] ^= 1  # another NaN
    found = one(ones, others)
    assert (found.index, found.largest, found.relative, found.count) == ((1,), 0.0, 0.0, 1)


@pytest.mark.parametrize(("a", "b"), [(NAN, 1.0), (1.0, NAN), (INF, 1.0), (INF, -INF)])
def test_nan_or_infinity_on_one_side_outweighs_every_finite_difference(a, b):
    found = one(torch.tensor([0.0, a]), torch.tensor([1e9, b]))
    assert found.index == (1,)
    assert not math.isfinite(found.largest)
    assert found.count == 2


TREE = {"net": {"w": [torch.zeros(1), torch.zeros(1)]}, 3: 1}


@pytest.mark.parametrize(
    ("a", "b", "found"),
    [
        ({"x": 1}, {"x": 1.0}, [("x", "kind")]),
        ({"x": True}, {"x": 1}, [("x", "kind")]),
        ({"x": "a"}, {"x": "b"}, [("x", "values")]),
        ([1, 2], [1], [("[1]", "only in A")]),
        (TREE, {"net": {"w": [torch.zeros(1), torch.ones(1)]}, 3: 2}, [("net.w[1]", "values"), ("3", "values")]),
        (torch.ones(2, 3), torch.ones(3, 2).T, []),  # The memory layout of a tensor does not change the comparison.
    ],
)
def test_a_difference_is_named_with_its_kind(a, b, found):
    assert [(d.name, d.kind) for d in differences(a, b)] == found


def test_leaves_are_counted_and_distances_are_euclidean_without_equal_infinities():
    assert count_leaves({"a": [1, 2], "b": {"c": torch.zeros(9)}}) == 3
    assert one(torch.tensor([INF, 1.0]), torch.tensor([INF, 3.0])).largest == 2.0
    a = {"x": torch.tensor([3.0, 0.0]), "y": torch.tensor([4.0])}
    b = {"x": torch.tensor([0.0, 0.0]), "y": torch.tensor([10.0])}
    assert (relative_distance(a, b), relative_distance(a, a)) == (pytest.approx(math.sqrt(9 + 36) / 10), 0.0)
    assert relative_distance(a, {"x": a["x"]}) == math.inf
