"""The scanner's pixel scale from the rods."""
