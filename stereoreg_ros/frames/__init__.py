"""Which frame to build: what one can do (`inspection`), and a search for one that does better (`search`)."""
