"""N simulations on MuJoCo: scene assembly, robot state, actuators and contact sensing."""
