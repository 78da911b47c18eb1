"""Going on with a run as if it had never stopped.

| module | offers |
|---|---|
| ``resume`` | opens the run and trains on |
| ``drop_past_checkpoint`` | drops what the logs hold past the last checkpoint |
| ``point`` | the last whole checkpoint, held against the log |
| ``changes`` | which settings overrides may change meanwhile, and what of the snapshot they rewrite |
| ``differences``, ``recomputed`` | what ends the claim that a resume is exact, and what proves it |
"""
