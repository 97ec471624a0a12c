"""The embedded town: streets, houses, vehicles and people from a seed."""
