"""Export a trained policy as a bundle: one folder that runs without this package.

| module | offers |
|---|---|
| ``export_bundle`` | the job: writes the bundle whole or not at all |
| ``bundle_specification``, ``exported_observations`` | ``policy.json``: the policy as numbers |
| ``bundle_check`` | recorded episodes, and the comparison of all exported policies with them |
| ``c_header``, ``bundle_readme`` | ``policy.h`` and ``README.md`` |
| ``bundle`` | files that are copied into the bundle |
"""
