"""Writing to rerun, reading recordings back, blueprints and digests."""
