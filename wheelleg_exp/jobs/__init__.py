"""Jobs of the commands: each job joins asset, environment, learning, run, and recording into one piece of work.

| module | offers |
|---|---|
| ``train`` | preparing, running, and resuming a training |
| ``replay`` | training a run again from its snapshot, and comparing |
| ``training_job`` | train, resume, or evaluate in a child process |
| ``run_sweep``, ``sweep_launchers``, ``sweep_queue`` | several trainings: as processes of this machine, or in a queue |
| ``pipeline`` | several tasks one after the other, with gates between them |
| ``play_policy``, ``run_agent``, ``drive`` | rollouts: of a policy, of zeros or noise, and driven by a user |
| ``evaluate_policy`` | evaluation in the scenarios of a protocol, and comparison of evaluations |
| ``result_record``, ``reproduce_result`` | a published result, and the check that it can be reproduced |
| ``export`` | a policy as a folder that runs without this package |
| ``diff_inputs`` | the two sides that ``wheelleg diff`` compares |
| ``rollout_figures``, ``rollout_files`` | what a rollout shows in numbers, and its recording and dataset |
| ``saved_robot``, ``torch_threads`` | the robot in a run directory, and torch's threads |
| ``job_display`` | displays of a job's progress |
"""
