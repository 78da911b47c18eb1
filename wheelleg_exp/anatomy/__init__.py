"""Find the wheels, legs, and stance of a robot, and measure the robot, by geometry and never by names."""
