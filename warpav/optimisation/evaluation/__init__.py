"""How good a rig is: metrics, coverage, blind ground, statistics."""
