"""A training: from a composed config, or from a stopped run, to a finished run directory.

The process of rank 0 runs ``prepare_training`` and ``run_training``. The remaining ranks run ``other_ranks``.
"""
