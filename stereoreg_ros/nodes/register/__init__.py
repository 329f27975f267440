"""register_node: images in, poses out."""
