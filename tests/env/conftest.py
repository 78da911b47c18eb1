"""Spy managers for the tests of the environment."""

from managers.conftest import _spies as _spies
from sim.small_envs import start_env as start_env
