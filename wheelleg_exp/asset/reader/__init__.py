"""Reads USD into a robot description."""
