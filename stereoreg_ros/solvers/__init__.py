"""Rods and spots known: which pose, which scale. Each solver in its own file."""
