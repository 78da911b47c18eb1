"""Compare a robot's log with a policy and a simulation, and identify the motors of a robot.

| module | offers |
|---|---|
| ``robot_log`` | a log's columns, read from CSV, Parquet, or MCAP |
| ``log_simulation`` | the simulated robot, driven by a log's targets |
| ``log_faults``, ``log_comparison`` | possible faults of a log, and the faults that explain it |
| ``motor_identification``, ``identified_profile`` | motor parameters from chirps, and a robot profile with them |
"""
