import copy

from sim.small_envs import ASSETS, env_config

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.run.run_config import on_reference_engine, upgrade_env_params


def earlier():
    """Return the parameters of an environment in the format before engines and terrains had keys."""
    config = env_config()
    for key in ("engine", "device"):
        del config["sim"][key]
    ground = config["scene"].pop("terrain")
    del ground["_target_"]
    config["scene"]["ground"] = ground
    config["scene"]["sensors"]["contact"]["_target_"] = "wheelleg_exp.sim.contact.ContactSensor"
    return config


def test_they_build_the_same_model():
    old = earlier()
    kept = copy.deepcopy(old)
    built = ManagerBasedRLEnv(upgrade_env_params(old), ASSETS / "rover.xml", 0)
    now = ManagerBasedRLEnv(env_config(), ASSETS / "rover.xml", 0)
    assert built.scene.model_digest() == now.scene.model_digest()
    assert (built.state_dict().keys(), old) == (now.state_dict().keys(), kept)


def test_present_ones_stay_as_they_are():
    assert upgrade_env_params(env_config()) == env_config()


def test_what_was_trained_on_a_gpu_is_played_on_the_cpu():
    trained = env_config(sim={"engine": "warp", "device": "cuda:0"})
    assert (on_reference_engine(trained), on_reference_engine(env_config())) == (env_config(), env_config())
