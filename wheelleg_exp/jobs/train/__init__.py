"""A training: from a composed config or a stopped run to a finished run directory."""
