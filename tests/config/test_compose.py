import pytest
import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir, version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from omegaconf.errors import ReadonlyConfigError

from wheelleg_exp.config.tree_lookup import at
from wheelleg_exp.errors import ConfigError

FOO = {"_target_": "shelf_terms.alive", "weight": 2}
POLICY, CRITIC = "env.observations.policy.terms", "env.observations.critic.terms"


@pytest.mark.parametrize(
    ("override", "path", "names"),
    [
        (None, POLICY, ["speed", "joints"]),
        (None, CRITIC, ["joints", "speed"]),
        (None, "env.commands", []),
        (f"observation@{POLICY}=[joints]", POLICY, ["joints"]),
        (f"observation@{POLICY}=[joints]", CRITIC, ["joints", "speed"]),
        ("+reward@env.rewards=smooth", "env.rewards", ["alive", "height", "smooth"]),
        ("event@env.events=[]", "env.events", []),
        ("~env.events.push", "env.events", []),
        ("+env.recorders=null", "env.recorders", []),
        ("env.rewards.height=null", "env.rewards", ["alive"]),
        (f"{POLICY}.speed=null", POLICY, ["joints"]),
    ],
)
def test_an_override_gives_a_section_these_terms_in_order(composed, override, path, names):
    config = composed(*filter(None, [override]))
    assert list(at(config.config, path)) == names
    is_null_term = str(override).endswith("=null") and not str(override).startswith("+")
    assert config.removed_terms == ((override.removesuffix("=null"),) if is_null_term else ())


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("env.rewards.alive.weight=4", "env.rewards.alive.weight", 4),
        # The task's comment has priority over the comment in the term's file.
        (None, "env.rewards.height.weight", -50.0),
        (None, "env.recorders", None),
        ("+env.rewards.foo={_target_: shelf_terms.alive, weight: 2}", "env.rewards.foo", FOO),
        ("++env.rewards.height={weight: 3}", "env.rewards.height.target_height", 0.07),
        ("robot=physical", "env.robot", {"asset": "real.usda"}),
    ],
)
def test_an_override_gives_a_key_this_value(composed, override, path, value):
    assert at(composed(*filter(None, [override])).config, path) == value


def test_the_raw_config_contains_interpolations_and_null_terms_and_is_read_only(composed):
    config = composed("task=walk", "seed=3", "env.rewards.height=null")
    assert config.config["env"]["num_envs"] == 3
    assert OmegaConf.to_container(config.raw, resolve=False)["env"]["num_envs"] == "${seed}"
    assert config.raw.env.rewards.height is None
    with pytest.raises(ReadonlyConfigError):
        config.raw.seed = 3


def test_another_primary_config_builds_on_the_first(composed):
    assert composed(primary="play").config["seed"] == 7


def test_a_task_of_the_user_extends_a_stock_task_and_its_files_are_known(composed, user, stock):
    config = composed("task=hop", config_dirs=[user])
    assert (list(config.config["env"]["rewards"]), config.config["task"]["name"]) == (["alive", "bounce"], "hop")
    assert config.asset_roots == (user.parent / "assets", user.parent)
    files = {loaded.file for loaded in config.loader.repository_used.loaded.values()}
    assert {user / "reward" / "bounce.yaml", stock / "task" / "stand.yaml"} <= files
    assert stock / "reward" / "height.yaml" not in files


@pytest.mark.parametrize(
    "values",
    [
        {"env": {"episode_length_s": "???", "decimation": None, "new": "???"}},
        {"env": {"scene": None, "episode_length_s": {"short": 1.0, "long": [2, {"a": "${seed}"}]}}},
        {"env": {"robot": {"order": [], "length": [1.0], "joint_pos": {"wheel": "${seed}", 3: 0.5}}}},
        {"env": {"robot": {"joint_pos": 0.0}, "sim": {}, "scene": {"spacing": {}}}},
        # In these cases, values of one file decide what happens to values of another file.
        {"env": {"copy": {"solver": "cg"}}},
        {"env": {"other": "???"}},
    ],
)
def test_composing_gives_what_hydra_gives(composed, edit, stock, values, monkeypatch):
    base = "# @package _global_\ndefaults:\n  - walk\n  - _self_\nenv:\n  copy: ${env.sim}\n  other: ${env.scene}\n"
    edit("task/base.yaml", base)
    edit("task/odd.yaml", "# @package _global_\ndefaults:\n  - base\n  - _self_\n" + yaml.safe_dump(values))
    overrides = ["task=odd", "env.rewards.height.weight=-3", "~env.events.push", "seed=3", "++env.new=1"]
    with initialize_config_dir(str(stock), version_base="1.3"):
        expected = hydra_compose("train", overrides)
    compose, merged = ConfigLoaderImpl._compose_config_from_defaults_list, []

    def counted(self, defaults, repo):
        merged.append(len(defaults))
        return compose(self, defaults, repo)

    monkeypatch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", counted)
    assert OmegaConf.to_yaml(composed(*overrides).raw) == OmegaConf.to_yaml(expected)
    assert (max(merged) > 1) == (not {"copy", "other"}.isdisjoint(values["env"]))  # Hydra merges only these files.


def test_a_file_of_a_package_is_merged_in_its_place(composed, stock):
    package = stock.parent / "shelf_package"
    (package / "task").mkdir(parents=True)
    for folder in (package, package / "task"):
        (folder / "__init__.py").touch()
    text = "# @package _global_\ndefaults: [walk, _self_]\nenv: {decimation: 7}\n"
    (package / "task" / "packed.yaml").write_text(text)
    assert composed("task=packed", "hydra.searchpath=[pkg://shelf_package]").config["env"]["decimation"] == 7


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("hydra: {searchpath: []}", "only supported from the primary config"),
        ("env: {robot: [1]}", "does not merge: Cannot merge DictConfig with ListConfig"),
    ],
)
def test_a_file_that_cannot_be_merged_with_earlier_files_is_refused(composed, edit, line, message):
    edit("task/walk.yaml", f"# @package _global_\ndefaults:\n  - stand\n  - _self_\n{line}\n")
    with pytest.raises(ConfigError, match=message):
        composed("task=walk")


def test_composing_does_not_change_hydras_globals(composed, stock):
    with initialize_config_dir(str(stock), version_base="1.2"):
        inside = GlobalHydra.instance().hydra
        composed()
        with pytest.raises(Exception, match="stnd"):
            composed("task=stnd")
        assert GlobalHydra.instance().hydra is inside
        assert (str(version.getbase()), hydra_compose("train").seed) == ("1.2", 1)
    GlobalHydra.instance().clear()
    composed()
    assert not GlobalHydra.instance().is_initialized()


def test_hydras_three_files_contain_the_config_and_the_overrides(composed):
    texts = composed("task=walk", "seed=5").hydra_files()
    assert sorted(texts) == ["config.yaml", "hydra.yaml", "overrides.yaml"]
    assert yaml.safe_load(texts["overrides.yaml"]) == ["task=walk", "seed=5"]
    assert yaml.safe_load(texts["config.yaml"])["env"]["num_envs"] == "${seed}"
    assert yaml.safe_load(texts["hydra.yaml"])["hydra"]["overrides"]["task"] == ["task=walk", "seed=5"]
    assert yaml.safe_load(texts["hydra.yaml"])["hydra"]["runtime"]["choices"]["task"] == "walk"


def test_a_path_with_blanks_and_quotes_can_be_a_config_folder(composed, user):
    odd = user.parent / "it's a folder, really"
    user.rename(odd)
    assert composed("task=hop", config_dirs=[odd]).config["task"]["name"] == "hop"
