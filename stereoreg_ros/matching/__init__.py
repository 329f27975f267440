"""Which spot is which rod, with false spots and missing rods."""
