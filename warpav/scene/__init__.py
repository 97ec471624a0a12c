"""Traffic scenes and where they come from."""
