"""Where operators make mistakes a pose is right, or refused; at full length: `python -m benchmarks.mistakes`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.result import Registration
from stereoreg_ros.simulation.mistakes import NO_ROD
from support.mistake_scenes import CASES, FRAMES, KINDS, LAYOUTS, frame_named, register, scene_of
from support.mistake_verdicts import Outcome, judge, measure, measure_cases, plausibility, row_of


def accepted(kind: str, frame: str, index: int) -> Registration:
    """The registration of a scene that has to be accepted."""
    result = register(scene_of(kind, frame, index))
    assert isinstance(result, Registration), result.message
    return result


@pytest.mark.parametrize(
    ("kind", "frame", "scenes"),
    [
        ("half_turn", "cube8", 8),
        ("half_turn", "zframe", 4),
        ("half_turn", "leksell_ct9", 3),
        ("spacing", "cube8", 6),
        ("spacing_prior", "random8", 4),
        ("rod_ends", "cube6", 6),
        ("rod_ends_prior", "zframe", 6),
        ("mirrored_rod", "cube6", 4),
        ("mirrored_rod_prior", "random6", 4),
        ("template_prior", "zframe", 5),
        ("sister_missing", "cube6", 4),
        ("fragments", "cube6", 3),
        ("collinear_missing", "cube6", 4),
    ],
)
def test_none_is_wrong(kind: str, frame: str, scenes: int) -> None:
    row = row_of(kind, frame, measure(kind, frame, 0, scenes))
    wrong = [outcome for outcome in row.wrong_scenes if not outcome.fits]
    assert not wrong, f"describe one: python -m benchmarks.mistakes --kinds {kind} --frames {frame} --scene INDEX"


def test_a_spot_of_a_row_in_the_place_of_a_missing_rod_is_not_taken_for_its_own() -> None:
    """All eight rods match, 14 degrees off: one with a needle's spot, which lies in line with the needle's others."""
    result = register(scene_of("collinear_missing", "random8", 14))
    assert not result
    assert result.reason == "ambiguous"


@pytest.mark.parametrize(
    ("kind", "frame"), [("true", "cube6"), ("true", "zframe"), ("as_built", "cube8"), ("as_built", "leksell_ct9")]
)
def test_true_scenes_are_accepted(kind: str, frame: str) -> None:
    row = row_of(kind, frame, measure(kind, frame, 0, 12))
    assert row.wrong == 0
    assert row.right + row.weak >= 11, row.refused


@pytest.mark.parametrize("kind", ["perfect", "small_both"])
def test_stated_errors(kind: str) -> None:
    row = row_of(kind, "cube8", measure(kind, "cube8", 0, 40))
    assert row.nees is not None
    # The mean of 40 chi-squares of six degrees of freedom has a standard deviation of 0.55.
    assert 4.0 <= row.nees <= 9.0
    assert row.right >= 38, row.refused


@pytest.mark.skipif(not CASES.exists(), reason=f"{CASES} is not there")
def test_cases_that_were_wrong() -> None:
    outcomes = measure_cases()
    assert len(outcomes) >= 28
    assert [outcome for outcome in outcomes if outcome.verdict == "wrong"] == []


class TestJudge:
    def test_right(self) -> None:
        scene = scene_of("true", "cube8", 0)
        outcome = judge(scene, accepted("true", "cube8", 0))
        assert outcome.verdict == "right"
        assert outcome.error_mm is not None
        assert outcome.error_mm < 2.0
        assert not outcome.fits, "only wrong poses need an excuse"

    @pytest.mark.parametrize(("shift_mm", "turn_deg"), [(2.5, 0.0), (0.0, 4.0)])
    def test_wrong_and_weak(self, shift_mm: float, turn_deg: float) -> None:
        scene, result = scene_of("true", "cube8", 0), accepted("true", "cube8", 0)
        found = result.scanner_from_frame
        truth = found.perturbed(np.array([shift_mm, 0.0, 0.0]), np.radians([turn_deg, 0.0, 0.0]))
        outcome = judge(replace(scene, truth=truth), result)
        assert outcome.verdict == "wrong"
        assert outcome.error_mm == pytest.approx(shift_mm)
        assert outcome.error_deg == pytest.approx(turn_deg)
        unsure = replace(result, estimate=replace(result.estimate, covariance=1e4 * result.covariance))
        assert judge(replace(scene, truth=truth), unsure).verdict == "weak"

    def test_near_is_right_however_sure(self) -> None:
        scene, result = scene_of("true", "cube8", 0), accepted("true", "cube8", 0)
        sure = replace(result, estimate=replace(result.estimate, covariance=1e-4 * result.covariance))
        assert judge(scene, sure).verdict == "right"
        assert judge(scene, sure, near_too=True).verdict == "wrong"

    def test_absent_frame(self) -> None:
        scene = replace(scene_of("true", "cube8", 0), truth=None, true_frame=None)
        assert judge(scene, accepted("true", "cube8", 0)).verdict == "wrong"

    def test_refusal(self) -> None:
        scene = scene_of("true", "cube8", 0)
        few = replace(scene, spots_px=scene.spots_px[:3], rods=scene.rods[:3])
        assert judge(few, register(few)) == Outcome(0, "too_few_spots", 0.0)

    def test_plausible_is_every_rod_with_its_own_spot_and_small_residuals(self) -> None:
        scene, result = scene_of("true", "cube8", 0), accepted("true", "cube8", 0)
        pose, shown = result.estimate.slice_from_frame, np.flatnonzero(scene.rods != NO_ROD)
        aside = Pose(pose.rotation, pose.translation + np.array([3.0, 0.0, 0.0]))
        moved = replace(result, estimate=replace(result.estimate, slice_from_frame=aside))
        far = scene.spots_px.copy()
        far[shown[0]] += [6.0, 0.0]
        values = [
            plausibility(one, other)
            for one, other in ((scene, result), (scene, moved), (replace(scene, spots_px=far), result))
        ]
        assert None not in values
        fitting, shifted, one_far = (value or 0.0 for value in values)
        assert fitting > 1e-3
        assert shifted < 1e-6
        assert one_far < 1e-6
        one_less = replace(result, estimate=replace(result.estimate, matches=result.matches[1:]))
        assert plausibility(scene, one_less) is None
        broken = replace(
            scene,
            spots_px=np.vstack([scene.spots_px, scene.spots_px[shown[0]] + [4.0, 0.0]]),
            rods=np.append(scene.rods, scene.rods[shown[0]]),
        )
        assert plausibility(broken, result) is None

    def test_other_matches_are_plausible_where_the_true_ones_do_not_fit(self) -> None:
        scene, result = scene_of("true", "cube8", 0), accepted("true", "cube8", 0)
        shown = np.flatnonzero(scene.rods != NO_ROD)
        swapped = scene.rods.copy()
        swapped[shown[:2]] = swapped[shown[1::-1]]
        value = plausibility(replace(scene, rods=swapped), result)
        assert value is not None
        assert value > 1e-3

    def test_a_twin_is_not_plausible_where_the_true_matches_fit_too(self) -> None:
        scene, result = scene_of("true", "leksell_ct", 0), accepted("true", "leksell_ct", 0)
        # Half a turn about x lays the two plates on themselves: front and back rods change places.
        other = [2, 1, 0, 5, 4, 3]
        half_turn = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, -120.0, -120.0]))
        twin = replace(
            result.estimate,
            slice_from_frame=result.estimate.slice_from_frame @ half_turn,
            matches=tuple(replace(match, line_index=other[match.line_index]) for match in result.matches),
        )
        assert (plausibility(scene, result) or 0.0) > 1e-3
        assert plausibility(scene, replace(result, estimate=twin)) is None


class TestRow:
    OUTCOMES = (
        Outcome(0, "right", 0.1, nees=5.0),
        Outcome(1, "weak", 0.1, nees=7.0),
        Outcome(2, "wrong", 0.3, caution=True, nees=90.0, plausibility=0.2),
        Outcome(3, "no_consensus", 0.1),
    )

    def test_counts(self) -> None:
        row = row_of("spacing", "cube6", list(self.OUTCOMES))
        assert (row.scenes, row.right, row.weak, row.wrong, row.fits, row.cautioned) == (4, 1, 1, 1, 1, 1)
        assert row.refused == {"no_consensus": 1}
        assert row.nees == pytest.approx(34.0)
        assert row.median_s == pytest.approx(0.1)

    def test_shortcoming(self) -> None:
        wrong = Outcome(4, "wrong", 0.1, nees=90.0, plausibility=1e-4)
        assert row_of("spacing", "cube6", list(self.OUTCOMES)).shortcoming == ""
        assert row_of("spacing", "cube6", [*self.OUTCOMES, wrong]).shortcoming == "WRONG"
        assert row_of("spacing", "cube6", [*[self.OUTCOMES[0]] * 999, wrong]).shortcoming == ""
        assert row_of("helical", "zframe", [wrong]).shortcoming == ""
        assert row_of("small_both", "cube6", [self.OUTCOMES[0]]).shortcoming == ""
        assert row_of("small_both", "cube6", [Outcome(0, "right", 0.1, nees=9.0)]).shortcoming == "NEES"
        assert row_of("cases", "", [wrong]).shortcoming == "WRONG"


class TestLayouts:
    def test_they_stay_the_same_and_differ(self) -> None:
        layouts = [frame_named(name) for name in LAYOUTS]
        assert [len(frame) for frame in layouts] == [5, 6, 7, 8, 9, 5, 6, 7, 8, 9]
        assert len({frame.starts.tobytes() for frame in layouts}) == 10
        assert frame_named("random3") is frame_named("random3")

    def test_plates(self) -> None:
        """Each N: two rods upright, and one from the foot of one to the head of the other."""
        for number in range(5, 10):
            frame = frame_named(f"random{number}")
            for first in range(0, 3 * (len(frame) // 3), 3):
                one, diagonal, other = (slice(first + k, first + k + 1) for k in range(3))
                for upright in (one, other):
                    assert frame.directions[upright, 2] == pytest.approx(1.0)
                feet = [frame.starts[one], frame.starts[other]]
                heads = [frame.ends[one], frame.ends[other]]
                distances = [np.linalg.norm(frame.starts[diagonal] - foot) for foot in feet]
                assert min(distances) == pytest.approx(0.0, abs=1e-9)
                head = heads[1 - int(np.argmin(distances))]
                assert frame.ends[diagonal] == pytest.approx(head)

    def test_every_kind_has_scenes_for_every_frame(self) -> None:
        for frame in FRAMES:
            for kind in KINDS:
                assert len(scene_of(kind, frame, 0).spots_px) >= 4
