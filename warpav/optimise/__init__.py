"""Floor 6: segregation, gradient descent with multipliers, baselines, and rival searches."""
