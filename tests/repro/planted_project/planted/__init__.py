"""Terms that each break one reproducibility promise, to show that the proofs detect it."""
