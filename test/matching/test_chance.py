"""What chance brings stays within what theory allows; at full length: `python -m benchmarks.clutter`."""

from __future__ import annotations

import math

import pytest

from support.clutter_counts import THRESHOLDS, Clutter, count


@pytest.mark.parametrize(
    ("clutter", "sets"),
    [
        (Clutter("cube6", 10, 14, 90.0, 0.3, 0.0), 30),
        (Clutter("zframe", 8, 12, 120.0, 0.3, 0.0), 30),
        (Clutter("leksell_ct", 8, 12, 256.0, 0.3, 0.0), 30),
        (Clutter("cube6", 8, 12, 256.0, 0.3, 0.0, tolerance_mm=0.5, scale_tolerance=0.005), 30),
    ],
    ids=lambda value: f"{value.frame}, {value.tolerance_mm} mm" if isinstance(value, Clutter) else "",
)
def test_no_more_than_expected(clutter: Clutter, sets: int) -> None:
    result = count(clutter, sets, seed=4)
    assert result.sets == sets
    for threshold in THRESHOLDS:
        expected = sets * 10**threshold
        # 4 standard deviations of a count of that mean.
        assert result.below[threshold] <= expected + 4 * math.sqrt(expected) + 1, threshold
    print(result)


def test_crowded_clutter_brings_some() -> None:
    """Lest the test above hold only because nothing is ever found."""
    result = count(Clutter("cube6", 18, 22, 90.0, 0.3, 0.0), 6, seed=5)
    assert result.below[0.0] >= 1


@pytest.mark.parametrize("name", ["cube6", "leksell_ct", "zframe"])
def test_none_is_accepted_at_the_default(name: str) -> None:
    result = count(Clutter(name, 5, 60, 256.0, 0.3, -6.0), 40, seed=6)
    assert result.accepted == 0
    assert set(result.reasons) <= {"no_consensus", "too_few_spots"}
