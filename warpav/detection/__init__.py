"""Detectors, matching and average precision."""
