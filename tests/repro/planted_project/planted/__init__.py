"""Terms that break a promise each, to show that the proofs see it."""
