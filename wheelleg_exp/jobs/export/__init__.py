"""Export a trained policy as a bundle: one folder that runs without this package.

``export_bundle`` is the job. The modules except ``bundle`` write the files of the bundle and check the exported
policies.
"""
