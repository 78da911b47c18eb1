"""Files of a bundle, which run without this package: ``runner`` needs NumPy, and ``simulate`` also needs MuJoCo."""
