"""Where a simulated frame stands: random poses as in the paper, and a frame that passes through the slice."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.simulation.scene import ScannerSettings

_TRIES = 2000
_MARGIN_PX = 4.0


def random_pose(
    rng: np.random.Generator,
    frame: Frame,
    settings: ScannerSettings,
    *,
    max_tilt_deg: float = 20.0,
    max_offset_mm: float = 50.0,
    max_depth_mm: float = 10.0,
    min_rods: int | None = None,
    nominal: Pose | None = None,
) -> Pose:
    """A random slice_from_frame with which at least `min_rods` rods (default: all) pass right through the slice.

    As in Maurin 2009, section 6, angles are uniform within `max_tilt_deg` about each axis and positions are uniform:
    the middle of the frame lies within `max_offset_mm` of the image's centre in x and y, and within `max_depth_mm` of
    the slice's plane. `nominal` is slice_from_frame with no tilt and no offset: its rotation says how the frame
    stands, its translation where the frame's origin lies (default: unturned, the frame's middle in the image's
    centre). All rods that reach the slice do so inside the image.
    Raises ValueError where no such pose is found.
    """
    wanted = len(frame) if min_rods is None else min_rods
    if not 0 <= wanted <= len(frame):
        raise ValueError(f"min_rods is {min_rods}, expected 0 to {len(frame)}, the rods of frame '{frame.name}'")
    centre = _centre(frame)
    rest = nominal or centred_pose(frame, settings)
    reach = np.array([max_offset_mm, max_offset_mm, max_depth_mm])
    for _ in range(_TRIES):
        tilt = Rotation.from_euler("xyz", rng.uniform(-max_tilt_deg, max_tilt_deg, 3), degrees=True).as_matrix()
        rotation = tilt @ rest.rotation
        middle = rest @ centre + rng.uniform(-reach, reach)
        pose = Pose(rotation, middle - rotation @ centre)
        if _rods_through(frame, pose, settings) >= wanted:
            return pose
    raise ValueError(
        f"frame '{frame.name}': no pose found with {wanted} rods through the slice and all cuts inside the image of "
        f"{settings.size_mm[0]:g} x {settings.size_mm[1]:g} mm"
    )


def centred_pose(
    frame: Frame, settings: ScannerSettings, share: tuple[float, float] = (0.5, 0.5), rotation: Array | None = None
) -> Pose:
    """slice_from_frame (mm) with the frame's middle in the slice's plane, at `share` of the image's width and height.

    rotation: (3, 3), slice_from_frame; unturned by default.
    """
    turned = np.eye(3) if rotation is None else rotation
    pixel = np.array(share) * settings.shape[::-1]
    return Pose(turned, np.append(settings.scale.to_mm(pixel), 0.0) - turned @ _centre(frame))


def passage(frame: Frame, middle: Pose, step_mm: float, *, drift_deg: float = 2.0, min_rods: int = 3) -> Iterator[Pose]:
    """Poses slice_from_frame of the frame on its way through the slice along z, endlessly to and fro.

    middle: slice_from_frame half way. From one slice to the next the frame moves by `step_mm` and its tilt drifts
    within `drift_deg`. The passage turns back where fewer than `min_rods` rods would reach the slice, so that some
    rods have left it towards both ends.
    Raises ValueError on a step that is not positive, or where no stretch has that many rods.
    """
    if not step_mm > 0:
        raise ValueError(f"step_mm is {step_mm}, expected a positive number of mm")
    if not 1 <= min_rods <= len(frame):
        raise ValueError(f"min_rods is {min_rods}, expected 1 to {len(frame)}, the rods of frame '{frame.name}'")
    ends = np.sort(np.stack([(middle @ frame.starts)[:, 2], (middle @ frame.ends)[:, 2]]), axis=0)
    # Moved by dz, a rod reaches the plane while its lower end is below it and its upper end above.
    low, high = -np.sort(ends[1])[-min_rods], -np.sort(ends[0])[min_rods - 1]
    if not low < high:
        raise ValueError(f"frame '{frame.name}': no slice is reached by {min_rods} rods at this pose")
    return _to_and_fro(frame, middle, step_mm, low, high, math.radians(drift_deg))


def _to_and_fro(frame: Frame, middle: Pose, step_mm: float, low: float, high: float, drift: float) -> Iterator[Pose]:
    centre = _centre(frame)
    count = 0
    while True:
        way = (count * step_mm) % (2 * (high - low))
        z = low + min(way, 2 * (high - low) - way)
        phase = np.array([0.11, 0.07, 0.05]) * count + [0.0, 2.0, 4.0]
        rotation = rotation_exp(drift / math.sqrt(3) * np.sin(phase)) @ middle.rotation
        yield Pose(rotation, middle @ centre + [0.0, 0.0, z] - rotation @ centre)
        count += 1


def _centre(frame: Frame) -> Array:
    """Middle (3,) mm of the box around the rods, in frame axes."""
    ends = np.concatenate([frame.starts, frame.ends])
    centre: Array = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    return centre


def _rods_through(frame: Frame, pose: Pose, settings: ScannerSettings) -> int:
    """How many rods go right through the slice's thickness; -1 where a rod cuts the slice outside the image."""
    starts, ends = pose @ frame.starts, pose @ frame.ends
    span = ends - starts
    cosine = np.abs(span[:, 2]) / np.linalg.norm(span, axis=1)
    rise = np.where(span[:, 2] == 0, 1.0, span[:, 2])
    share = np.where(span[:, 2] == 0, np.nan, -starts[:, 2] / rise)
    cuts = settings.scale.to_px((starts + share[:, None] * span)[:, :2])
    reached = (share >= 0) & (share <= 1)
    last = np.array(settings.shape[::-1]) - 1 - _MARGIN_PX
    if not ((cuts[reached] >= _MARGIN_PX) & (cuts[reached] <= last)).all():
        return -1
    # The whole cross-section must leave the slab on both sides, or the spot's centre is not the cut.
    needed = 0.5 * settings.slice_thickness_mm + 0.5 * frame.diameters * np.sqrt(1 - cosine**2)
    whole = (np.minimum(starts[:, 2], ends[:, 2]) <= -needed) & (np.maximum(starts[:, 2], ends[:, 2]) >= needed)
    return int(whole.sum())
