"""The pixel scale from the wires of a real CatPhan, beside what DICOM says; its wires were determined with DICOM's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import load_frame
from stereoreg_ros.calibration.calibrate import Calibration, calibrate
from stereoreg_ros.spots import find_spots
from support.real_images import CATPHAN_OPTIONS, catphan, height, shows_module


@pytest.mark.parametrize("factors", [(1.0, 1.0), (1.05, 0.93)])
def test_scale_of_several_slices(factors):
    frame = load_frame("catphan_ctp404")
    inner = sorted(filter(shows_module, catphan()), key=height)[1:-1]  # in the outer two the wires end
    true = inner[0].ct_slice.scale
    told = replace(true, sx=factors[0] * true.sx, sy=factors[1] * true.sy)
    slices = []
    for one in inner:
        ct_slice = replace(one.ct_slice, scale=told)
        slices.append(find_spots(ct_slice, CATPHAN_OPTIONS))
    found = calibrate(slices, frame, told, CATPHAN_OPTIONS)
    assert isinstance(found, Calibration), found.message
    print(found.message)
    assert found.slices >= 5
    assert found.scale.sx == pytest.approx(true.sx, rel=0.005)
    assert found.scale.sy == pytest.approx(true.sy, rel=0.005)
    # The wires are known to 0.4 mm, at 58 mm from the centre: half a per cent of the scale, whatever the slices say.
    of_slices = np.sqrt(np.square(found.standard_errors) - np.square(found.frame_errors))
    assert of_slices.max() < 0.002 * true.sx
    assert max(found.frame_errors) < 0.006 * true.sx
