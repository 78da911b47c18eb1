"""Running a run again from its snapshot alone, and holding the result against the original.

| module | offers |
|---|---|
| ``replay`` | the job: what is required, restored, trained, compared |
| ``requirements`` | what a run must be before it is replayed |
| ``source_trees`` | every recorded source tree in a folder of its own |
| ``training_process`` | the training's process, seen from the replay |
| ``boot``, ``snapshot_training`` | what runs in it, on the code of the run |
"""
