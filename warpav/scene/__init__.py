"""Floor 2: traffic scenes and where they come from."""
