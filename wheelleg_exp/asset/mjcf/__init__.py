"""Write a robot description as MJCF, and compare the compiled model with the robot description."""
