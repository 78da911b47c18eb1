"""Several trainings from one command line, each in a process of its own, and their index.

| module | offers |
|---|---|
| ``sweep`` | runs the jobs, a fixed number at once, and keeps the index up to date |
| ``job`` | one of them, inside its process |
| ``launchers``, ``choosing`` | where jobs run: as processes of this machine, or in the queue that is chosen |
| ``queued``, ``carrier`` | a job of a queue: the near end, and the far end on another machine |
| ``submitit_launcher``, ``ray_launcher`` | the queues: Slurm's, or a Ray cluster |
"""
