"""What everything else is said in: poses, frames of rods, slices, and the projection that links them."""
