"""A training: from a composed config to a run directory.

| module | offers |
|---|---|
| ``training`` | prepared, run, finished: one order for trainings, resumes and replays |
| ``outputs``, ``training_recording`` | what it writes as it goes |
| ``films`` | a film every so many iterations |
| ``wandb_log`` | scalars sent to Weights & Biases |
| ``event_files`` | TensorBoard's files, cut behind a checkpoint |
| ``source_roots`` | which folders hold the source of a training |
"""
