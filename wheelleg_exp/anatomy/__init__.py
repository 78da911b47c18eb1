"""Anatomy of a robot (wheels, legs, stance) and measured facts, which are found by geometry, never by a name."""
