"""Scenes from recorded traffic: who drove where is recorded, what they and the street look like is made."""
