"""Floor 5: constraints and the losses of the thesis."""
