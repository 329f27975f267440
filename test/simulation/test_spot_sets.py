"""Sets of spots with a known answer: as much noise as they say, and nothing in an order that gives the answer away."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros import PixelScale, load_frame
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation import ScannerSettings, SpotSet, SpotSetSettings, random_spot_set

FRAME = load_frame("cube6")
SCANNER = ScannerSettings(scale=PixelScale(0.45, 0.6))


def drawn(count: int, visible: int, false: int, noise_px: float, gaussian: bool) -> list[SpotSet]:
    settings = SpotSetSettings(SCANNER, visible, false, noise_px, gaussian)
    return [random_spot_set(np.random.default_rng(seed), FRAME, settings) for seed in range(count)]


@pytest.mark.parametrize("gaussian", [False, True])
def test_noise_is_as_large_as_stated(gaussian: bool) -> None:
    settings = SpotSetSettings(SCANNER, 6, 0, 0.4, gaussian)
    off = []
    for one in drawn(150, 6, 0, 0.4, gaussian):
        exact = project(FRAME, one.slice_from_frame, SCANNER.scale)[0]
        nearest = np.linalg.norm(one.spots_px[:, None] - exact, axis=-1).argmin(axis=1)
        assert sorted(nearest) == list(range(6))
        off.append(one.spots_px - exact[nearest])
    assert np.std(off) == pytest.approx(settings.noise_std_px, rel=0.05)
    assert settings.noise_std_px == pytest.approx(0.4 if gaussian else 0.4 / np.sqrt(3))
    assert (np.abs(off).max() <= 0.4) is not gaussian


def test_any_rods_are_seen_and_their_spots_lie_anywhere_among_the_others() -> None:
    seen, places = set(), set()
    for one in drawn(40, 4, 4, 0.0, False):
        exact = project(FRAME, one.slice_from_frame, SCANNER.scale)[0]
        spots, rods = np.nonzero(np.linalg.norm(one.spots_px[:, None] - exact, axis=-1) < 1e-9)
        assert len(rods) == 4
        assert len(one.spots_px) == 8
        seen |= set(rods.tolist())
        places |= set(spots.tolist())
    assert seen == set(range(6))
    assert places == set(range(8))
