"""The thesis's losses and constraints, equation by equation."""
