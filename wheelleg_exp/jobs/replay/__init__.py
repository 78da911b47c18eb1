"""Train a run again from its snapshot alone, in a child process, and compare the result with the original run."""
