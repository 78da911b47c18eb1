"""Reads robots from URDF: MuJoCo's own reader for what it reads, the XML for what it passes over in silence."""
