"""The rsl_rl adapter, training, checkpoints that hold everything, and export."""
