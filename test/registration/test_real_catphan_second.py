"""Another CatPhan on another scanner: not exactly the one in the frame file, and upside down it may fit better."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.options import AUTO
from support.real_images import catphan_second, row_of
from support.real_scenes import CATPHAN_SECOND, catphan_rest, turn_deg

THRESHOLDS = pytest.mark.parametrize("threshold", ["300", AUTO])
# By the data's own description: the right way up.
UPRIGHT = Pose(np.eye(3), np.array([0.7, 0.8, 30.5]))


@pytest.fixture(scope="module", autouse=True)
def series():
    return catphan_second()


def test_it_rests_the_right_way_up():
    rest = catphan_rest(CATPHAN_SECOND)
    np.testing.assert_allclose(rest.translation, UPRIGHT.translation, atol=0.3)
    assert turn_deg(rest, UPRIGHT) < 2.0


@THRESHOLDS
def test_without_prior_none_is_upside_down(threshold):
    figures = row_of(f"catphan second/{threshold}/no prior/module")
    assert max((one.turn_deg for one in figures.accepted), default=0.0) < 10.0
    assert not figures.missed


@THRESHOLDS
def test_with_a_prior_the_middle_slices_are_accepted(threshold):
    figures = row_of(f"catphan second/{threshold}/prior/middle")
    assert not figures.missed


@THRESHOLDS
def test_end_slices_are_within_their_stated_errors_or_refused(threshold):
    figures = row_of(f"catphan second/{threshold}/prior/end")
    assert len(figures.attempts) == 4
    assert not figures.missed


@THRESHOLDS
@pytest.mark.parametrize("told", ["prior", "no prior"])
def test_slices_beside_the_module_are_refused(threshold, told):
    figures = row_of(f"catphan second/{threshold}/{told}/others")
    assert not figures.missed
