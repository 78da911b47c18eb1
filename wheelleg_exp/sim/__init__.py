"""N simulations of one scene on MuJoCo: scene assembly, robot, actuators, sensors, and terrain."""
