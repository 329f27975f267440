"""What every node has."""
