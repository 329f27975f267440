"""DICOM files of a simulated frame whose true poses are known, so that whatever is published can be judged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydicom.uid import generate_uid

from stereoreg_ros import PixelScale, Pose, load_frame
from stereoreg_ros.geometry.pose import rotation_angle, rotation_exp
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from support.dicom_files import write_slice

FRAME = load_frame("cube6")
# Far enough apart that a pose tells which slice it is of; at 0, where one without its plane would be, there is none.
APART_MM = 1000.0
_SHAPE = (256, 256)


@dataclass(frozen=True)
class Scanner:
    """told: the pixel scale in its files; true: that of its slices."""

    name: str
    told: PixelScale
    true: PixelScale
    tilt_deg: float


# The first has to be calibrated, the second not; by the scale of the other a slice of either is off by a millimetre.
CALIBRATED = Scanner("calibrated", PixelScale(0.5, 0.5), PixelScale(0.505, 0.4975), 20.0)
EXACT = Scanner("exact", PixelScale(0.513, 0.513), PixelScale(0.513, 0.513), -10.0)


@dataclass(frozen=True, eq=False)
class KnownSlice:
    """A slice in a file, and where its frame truly stands: scanner_from_frame, mm."""

    number: int
    scanner: Scanner
    path: Path
    scanner_from_frame: Pose

    def off(self, scanner_from_frame: Pose) -> tuple[float, float]:
        """How far off a pose of this slice is: mm at the frame's origin, and degrees."""
        apart = self.scanner_from_frame.inverse() @ scanner_from_frame
        return float(np.linalg.norm(apart.translation)), float(np.degrees(rotation_angle(apart.rotation)))


def draw(folder: Path, scanner: Scanner, numbers: range, rng: np.random.Generator) -> dict[int, KnownSlice]:
    """Draw the slices of these numbers into `folder`: one series, the frame moved anew for each."""
    settings = ScannerSettings(shape=_SHAPE, scale=scanner.true, false_spots=3, body=False)
    rotation = rotation_exp(np.radians([scanner.tilt_deg, 0.0, 0.0]))
    series = generate_uid()
    slices = {}
    for number in numbers:
        slice_from_frame = random_pose(rng, FRAME, settings, max_offset_mm=12.0)
        hu = render_slice([PlacedFrame(FRAME, slice_from_frame)], settings, rng).hu
        position = np.array([-60.0, -50.0, APART_MM * number])
        path = write_slice(
            folder / f"{scanner.name}_{number}.dcm",
            np.clip(np.rint(hu) + 1024, 0, 65535),
            SeriesInstanceUID=series,
            PixelSpacing=[scanner.told.sy, scanner.told.sx],
            ImagePositionPatient=position.tolist(),
            ImageOrientationPatient=[round(float(one), 12) for one in rotation[:, :2].T.ravel()],
        )
        slices[number] = KnownSlice(number, scanner, path, Pose(rotation, position) @ slice_from_frame)
    return slices


def number_of(scanner_from_frame: Pose) -> int:
    """The number of the slice that a pose can only be of; 0: of none."""
    return round(float(scanner_from_frame.translation[2]) / APART_MM)
