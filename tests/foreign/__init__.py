"""Run directories, projects and repositories of somebody hostile: no command but ``replay`` runs their code."""
