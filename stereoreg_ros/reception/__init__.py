"""Slices from a scanner, over a DICOM association or through a folder; without ROS."""
