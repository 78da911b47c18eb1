import pytest

from wheelleg_exp.project.create import NameTaken, require_name


@pytest.mark.parametrize("name", ["myrobot", "my_robot", "Diablo2", "r2d2"])
def test_valid_names_are_accepted_and_suggested_for_similar_invalid_ones(name):
    require_name(name)
    with pytest.raises(NameTaken) as caught:
        require_name(f"{name}-")
    assert caught.value.nearest == name


@pytest.mark.parametrize(
    ("name", "because", "nearest"),
    [
        ("my-robot", "not a valid name of a Python package", "my_robot"),
        ("2wheels", "not a valid name of a Python package", "robot_2wheels"),
        ("röbot", "not a valid name of a Python package", "r_bot"),
        ("", "not a valid name of a Python package", "my_robot"),
        ("class", "not a valid name of a Python package", "class_robot"),
        ("test", "another part of a project", "test_robot"),
        ("stand", "a stock config, task/stand", "stand_robot"),
        ("wheelleg_exp", "an installed Python package", "wheelleg_exp_robot"),
        ("null", "a value in YAML", "null_robot"),
    ],
)
def test_invalid_names_are_refused_with_the_nearest_valid_name(name, because, nearest):
    with pytest.raises(NameTaken, match=because) as caught:
        require_name(name)
    assert caught.value.nearest == nearest
    require_name(nearest)
