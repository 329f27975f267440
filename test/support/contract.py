"""What the contract fixes, written out: the code must not be compared with itself."""

from __future__ import annotations

DIAGNOSTIC_KEYS = [
    "outcome",
    "reason",
    "frame",
    "spots",
    "lines",
    "inliers",
    "residual_rms_mm",
    "residual_rms_px",
    "log10_false_alarms",
    "ambiguous_poses",
    "position_std_mm",
    "rotation_std_deg",
    "target_error_95_mm",
    "pixel_spacing_x_mm",
    "pixel_spacing_y_mm",
    "calibration",
    "duration_ms",
]

REASONS = [
    "too_few_spots",
    "no_consensus",
    "ambiguous",
    "degenerate",
    "inaccurate",
    "contradicted",
    "bad_image",
    "bad_frame",
    "skipped",
    "internal_error",
]

PUBLISHED = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "target_in_frame": "geometry_msgs/msg/PointStamped",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "overlay": "sensor_msgs/msg/Image",
    "markers": "visualization_msgs/msg/MarkerArray",
}
SUBSCRIBED = {
    "image": "sensor_msgs/msg/Image",
    "slice_pose": "geometry_msgs/msg/PoseStamped",
    "slice_spacing": "geometry_msgs/msg/Vector3Stamped",
    "target": "geometry_msgs/msg/PointStamped",
}
SERVICES = {
    "~/recalibrate": "std_srvs/srv/Trigger",
    "~/reset_calibration": "std_srvs/srv/Trigger",
}
STATUS_NAME = "register_node: registration"
