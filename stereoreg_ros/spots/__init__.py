"""Slice -> spots: which bright things may be cuts of rods, and where exactly their centres are."""

from stereoreg_ros.spots.finding import FoundSpots, find_spots

__all__ = ["FoundSpots", "find_spots"]
