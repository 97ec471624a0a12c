"""Sight: which cameras see what around the vehicle, and what has to be seen there."""
