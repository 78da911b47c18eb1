"""A training: from a composed config, or from a stopped run, to a finished run directory.

``prepare_training`` and ``run_training`` are the steps of rank 0, and ``other_ranks`` those of the remaining ranks.
"""
