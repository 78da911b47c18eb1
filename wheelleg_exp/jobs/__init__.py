"""Jobs of the commands: each joins asset, environment, learning, run, and recording (list: docs/tables/modules.md)."""
