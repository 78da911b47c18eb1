"""Find the bodies of a USD stage, connect them as trees, and compute their mass properties."""
