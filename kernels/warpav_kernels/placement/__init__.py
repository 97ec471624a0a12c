"""Camera poses on the mount surface, losses and constraints of a placement."""
