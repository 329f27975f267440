"""Slice -> spots: which bright things may be cuts of rods, and where exactly their centres are."""

from stereoreg_ros.spots.finding import find_spots

__all__ = ["find_spots"]
