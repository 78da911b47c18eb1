"""Export a trained policy as a bundle: one folder that runs without this package.

``export_bundle`` is the job. The package ``bundle`` contains the Python files that a bundle runs. The remaining modules
write the files of a bundle and check its policies.
"""
