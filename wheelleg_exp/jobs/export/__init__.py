"""Export a trained policy as a bundle: one folder that runs without this package.

``export_bundle`` is the job. The package ``bundle`` contains the Python programs that are copied into each exported
folder.
"""
