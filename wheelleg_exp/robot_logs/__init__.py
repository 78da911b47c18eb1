"""Compare a robot's log with a policy and a simulation, and identify the motors of a robot."""
