"""Writes a robot description as MJCF."""
