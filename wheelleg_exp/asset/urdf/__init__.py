"""Read robots from URDF: the tree of links, mass properties, and shapes; report everything that was left out."""
