"""Export a policy as a folder that runs without this package; ``bundle`` has the programs that are copied into it."""
