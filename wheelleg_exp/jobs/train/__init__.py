"""A training: from a composed config, or from a stopped run, to a finished run directory.

| module | offers |
|---|---|
| ``prepare_training`` | the ordered steps from a composed config to a training that is ready to run |
| ``run_training`` | the training itself |
| ``resume_training``, ``resume_point``, ``resume_overrides`` | preparing a resume: checkpoint, files, settings |
| ``other_ranks`` | the part of the ranks above 0, which write no files |
| ``training_outputs``, ``training_recording``, ``scalar_logs`` | the files that a training writes |
| ``initial_networks`` | networks of other runs: the initial policy and the teacher |
| ``source_roots`` | the folders of a training's source, and differences from a run's source and machine |
"""
