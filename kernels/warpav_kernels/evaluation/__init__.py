"""Ground that cameras see."""
