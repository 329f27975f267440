"""Slices that come from a scanner, over DICOM's network or through a folder; knows nothing of ROS."""
