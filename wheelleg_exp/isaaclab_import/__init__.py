"""Import a policy that was trained elsewhere, as a run of Isaac Lab or a folder for deployment, without running it."""
