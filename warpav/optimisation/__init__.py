"""Where the cameras go: mount poses, constraints, losses, the objective, descent and searches."""
