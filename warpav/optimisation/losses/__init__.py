"""What an optimisation lowers, and what its losses have in common; those of the thesis are in `warpav.thesis`."""
