from sim.small_envs import start_env as start_env
