"""Where slices come from: the scanner's network, files, or a simulation."""
