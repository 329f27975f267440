"""A simulated CT scanner: slices of placed frames, rendered from the physics and independent of what it judges."""

from stereoreg_ros.simulation.motion import centred_pose, passage, random_pose
from stereoreg_ros.simulation.rendering import Cylinder, add_metal
from stereoreg_ros.simulation.scene import PlacedFrame, ScannerSettings, metal_fraction, render_slice
from stereoreg_ros.simulation.spot_sets import SpotSet, SpotSetSettings, random_spot_set

__all__ = [
    "Cylinder",
    "PlacedFrame",
    "ScannerSettings",
    "SpotSet",
    "SpotSetSettings",
    "add_metal",
    "centred_pose",
    "metal_fraction",
    "passage",
    "random_pose",
    "random_spot_set",
    "render_slice",
]
