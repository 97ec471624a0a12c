"""Floor 4: detectors, matching and average precision."""
