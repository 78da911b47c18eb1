"""Import a policy that was trained elsewhere: an Isaac Lab run folder, or a folder for deployment.

``make_project`` reads the folder, converts its config (``env_mapping``, ``term_mapping``, ``agent_mapping``) and its
networks (``policy_weights``), and writes a project and a run directory. No file of the folder is executed.
"""
