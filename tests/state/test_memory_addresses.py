"""Test that shared memory is found from addresses alone, because the host cannot read GPU memory."""

import numpy as np
import pytest
import torch

from wheelleg_exp.state.unsaved_state import _array

BASE = torch.zeros(6, 4)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (BASE[:, 0], BASE[:, 1]),
        (BASE[:, 0], BASE),
        (BASE[:3], BASE[3:]),
        (BASE[:4], BASE[3:]),
        (BASE.T[1], BASE[2]),
        (BASE[:, 2:], BASE[:, :2]),
        (BASE.bool(), BASE),
    ],
)
def test_the_answer_is_that_of_arrays(a, b):
    assert np.shares_memory(_array(a), _array(b)) is np.shares_memory(a.numpy(), b.numpy())


def test_no_address_is_read():
    far = _array(BASE)
    interface = {**far.__array_interface__, "data": (1 << 44, True)}
    nowhere = np.asarray(type("Far", (), {"__array_interface__": interface})())
    assert not np.shares_memory(nowhere, far)
    assert np.shares_memory(nowhere, nowhere)
