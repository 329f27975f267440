"""The paper's own matching: as its figure 5 and its eq. 27 say, right when accepted, and bounded in its time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut, point_line_distances
from stereoreg_ros.matching import maurin2009
from stereoreg_ros.matching.hypothesis import UNMATCHED
from stereoreg_ros.matching.maurin2009 import SUCCESS, Consensus, _consensus, _one_to_one, samples_for, search
from stereoreg_ros.simulation import ScannerSettings, SpotSet, SpotSetSettings, random_spot_set
from stereoreg_ros.solvers.linear_system import condition_number
from support.frames import cube_by_hand

SCANNER = ScannerSettings()
SCALE = SCANNER.scale
NOISE_PX = 0.1
OPTIONS = RegistrationOptions(matcher="maurin2009", spot_noise_px=NOISE_PX)
# Six rods give so many ordered choices of four.
ARRANGEMENTS = 360


@pytest.fixture(scope="module")
def cube() -> Frame:
    return cube_by_hand()


def problem(seed: int, cube: Frame, false_spots: int = 0, visible: int = 6) -> SpotSet:
    given = SpotSetSettings(SCANNER, visible, false_spots, NOISE_PX, gaussian=True)
    return random_spot_set(np.random.default_rng(seed), cube, given)


def errors(found: Pose, true: Pose) -> tuple[float, float]:
    """Position in mm, rotation in degrees."""
    turn = np.degrees(rotation_angle(found.rotation @ true.rotation.T))
    return float(np.linalg.norm(found.translation - true.translation)), float(turn)


class TestSamples:
    @pytest.mark.parametrize(
        ("lines", "spots", "expected"),
        [
            (6, 10, 34),  # w^4 = 0.6^4 = 0.1296; log 0.01 / log 0.8704 = 33.2
            (6, 14, 135),  # (3/7)^4 = 0.03374; 134.2
            (6, 30, 2876),  # 0.2^4 = 0.0016; 2875.9
            (6, 8, 13),  # 0.75^4 = 0.3164; 12.1
            (6, 7, 7),  # (6/7)^4 = 0.5398; 5.9, and no fewer than there are spots
            (6, 6, 6),  # without outliers one is enough
            (6, 4, 4),  # more rods than spots
        ],
    )
    def test_by_hand(self, lines: int, spots: int, expected: int) -> None:
        assert samples_for(lines, spots) == expected

    @pytest.mark.parametrize(("lines", "spots"), [(6, 10), (5, 20), (12, 30), (7, 15)])
    def test_is_the_least_that_brings_the_wanted_probability(self, lines: int, spots: int) -> None:
        """Eq. 27: (1 - w^4)^N = 1 - p."""
        n, dirty = samples_for(lines, spots), 1 - (lines / spots) ** 4
        assert 1 - dirty**n >= SUCCESS > 1 - dirty ** (n - 1)


class TestRegistration:
    @pytest.mark.parametrize(("false_spots", "least"), [(0, 6), (2, 5)])
    def test_finds_most_poses_and_accepts_no_wrong_one(self, false_spots: int, least: int, cube: Frame) -> None:
        accepted = 0
        for seed in range(10):
            given = problem(seed, cube, false_spots)
            result = register_spots(given.spots_px, cube, SCALE, OPTIONS)
            if result:
                accepted += 1
                position, turn = errors(result.scanner_from_frame, given.slice_from_frame)
                assert position < 0.5
                assert turn < 0.5
                assert result.estimate.inliers >= 5
        assert accepted >= least

    def test_is_selected_by_its_name(self, cube: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
        calls: list[int] = []

        def counted(spots_mm: Array, frame: Frame, noise_mm: float) -> maurin2009.Search:
            calls.append(len(spots_mm))
            # Three times that of a spot, which is 0.1 pixel of half a millimetre.
            assert noise_mm == pytest.approx(0.15)
            return search(spots_mm, frame, noise_mm)

        monkeypatch.setattr(maurin2009, "search", counted)
        spots = problem(0, cube).spots_px
        assert register_spots(spots, cube, SCALE, RegistrationOptions(spot_noise_px=NOISE_PX))
        assert calls == []
        assert register_spots(spots, cube, SCALE, replace(OPTIONS, frame_tolerance_mm=0.0, scale_tolerance=0.0))
        assert calls == [6]

    def test_is_deterministic(self, cube: Frame) -> None:
        spots = problem(3, cube).spots_px
        first, again = (register_spots(spots, cube, SCALE, OPTIONS) for _ in range(2))
        assert first
        assert again
        np.testing.assert_array_equal(first.scanner_from_frame.rotation, again.scanner_from_frame.rotation)
        np.testing.assert_array_equal(first.scanner_from_frame.translation, again.scanner_from_frame.translation)

    def test_what_it_finds_is_refined_and_judged_like_any_other_match(self, cube: Frame) -> None:
        """The same pose, as uncertain and as unlikely by chance, as of the same matches found the other way."""
        spots = problem(0, cube).spots_px
        given = RegistrationOptions(spot_noise_px=NOISE_PX, min_inliers=6)
        paper, ours = (
            register_spots(spots, cube, SCALE, replace(given, matcher=m)) for m in ("maurin2009", "three_line")
        )
        assert paper
        assert ours
        np.testing.assert_allclose(paper.scanner_from_frame.translation, ours.scanner_from_frame.translation, atol=1e-4)
        stds = np.sqrt(np.diag(ours.covariance))
        np.testing.assert_allclose((paper.covariance - ours.covariance) / np.outer(stds, stds), 0.0, atol=0.01)
        assert paper.estimate.chi_square == pytest.approx(ours.estimate.chi_square, rel=0.01)
        assert paper.estimate.log10_false_alarms == pytest.approx(ours.estimate.log10_false_alarms, abs=0.01)

    def test_clutter_alone_is_refused(self, cube: Frame) -> None:
        for seed in range(3):
            spots = np.random.default_rng(seed).uniform(100, 400, (6, 2))
            assert not register_spots(spots, cube, SCALE, OPTIONS)

    def test_the_nominal_orientation_counts(self, cube: Frame) -> None:
        given = problem(0, cube)
        turned = RegistrationOptions(
            matcher="maurin2009", spot_noise_px=NOISE_PX, nominal_orientation=(1.0, 0.0, 0.0, 0.0), max_rotation_deg=60
        )
        assert register_spots(given.spots_px, cube, SCALE, OPTIONS)
        assert not register_spots(given.spots_px, cube, SCALE, turned)


class TestSearch:
    def test_qualified_samples_are_what_they_say(self, cube: Frame) -> None:
        given = problem(3, cube)
        spots_mm, noise_mm = SCALE.to_mm(given.spots_px), 0.15
        result = search(spots_mm, cube, noise_mm)
        assert result.qualified
        farthest = 0.0
        assert [one.std_mm for one in result.qualified] == sorted(one.std_mm for one in result.qualified)
        for one in result.qualified:
            lines, spots = np.array(one.pairs).T
            assert len(set(lines)) > 4
            distances = point_line_distances(cube, lines, one.frame_from_slice.inverse(), spots_mm[spots])
            assert distances.max() < math.sqrt(6) * noise_mm
            farthest = max(farthest, float(distances.max()))
            assert one.std_mm == pytest.approx(np.sqrt((distances**2).mean()))
            in_frame = one.frame_from_slice @ np.column_stack([spots_mm[spots], np.zeros(len(spots))])
            position = np.einsum("ij,ij->i", cube.directions[lines], in_frame)
            assert (position >= cube.lambda_min[lines]).all()
            assert (position <= cube.lambda_max[lines]).all()
        assert farthest > 0.8 * math.sqrt(6) * noise_mm, "all that are within reach count"
        position, _ = errors(result.qualified[0].frame_from_slice.inverse(), given.slice_from_frame)
        assert position < 3

    @pytest.mark.parametrize("is_lower", [True, False])
    def test_a_spot_beyond_a_rods_end_is_not_on_it(self, is_lower: bool, cube: Frame) -> None:
        """The last rod ends 5 mm before the slice; prolonged it would hit its spot."""
        start = Pose(rotation_exp(np.array([0.1, -0.15, 0.3])), np.array([120.0, 110.0, 2.0]))
        cuts = cut(cube, start.rotation, start.translation)
        ends = cube.points(np.arange(6), cuts.lambdas + (5.0 if is_lower else -5.0))
        starts, stops = cube.starts.copy(), cube.ends.copy()
        (starts if is_lower else stops)[5] = ends[5]
        shortened = replace(cube, starts=starts, ends=stops)
        best = search(cuts.points_mm, shortened, 0.15).qualified[0]
        assert [*best.pairs] == [(row, row) for row in range(5)]

    def test_two_spots_on_one_rod_make_no_fifth_inlier(self, cube: Frame) -> None:
        start = Pose(rotation_exp(np.array([0.1, -0.15, 0.3])), np.array([120.0, 110.0, 2.0]))
        cuts = cut(cube, start.rotation, start.translation).points_mm
        four = np.arange(4)
        doubled = np.concatenate([cuts[:4], cuts[:1] + 0.05])
        assert _consensus(doubled, cube, four, four, 0.3) is None
        found = _consensus(cuts[:5], cube, four, four, 0.3)
        assert found is not None
        assert [*found.pairs] == [(row, row) for row in range(5)]

    def test_draws_as_many_samples_as_planned(self, cube: Frame) -> None:
        result = search(SCALE.to_mm(problem(1, cube).spots_px), cube, 0.15)
        assert result.samples == result.planned == samples_for(6, 6) * ARRANGEMENTS
        assert result.seconds > 0

    @pytest.mark.parametrize("limit", [0, 1, 500, 800])
    def test_max_samples_bounds_the_search(self, limit: int, cube: Frame) -> None:
        spots_mm = SCALE.to_mm(problem(1, cube, false_spots=24).spots_px)
        result = search(spots_mm, cube, 0.15, max_samples=limit)
        assert result.planned == samples_for(6, 30) * ARRANGEMENTS
        # Whole sets of spots, each with every arrangement of rods.
        assert result.samples == math.ceil(limit / ARRANGEMENTS) * ARRANGEMENTS

    def test_the_same_seed_gives_the_same_search(self, cube: Frame) -> None:
        spots_mm = SCALE.to_mm(problem(2, cube, false_spots=2).spots_px)
        first, again, other = (search(spots_mm, cube, 0.15, max_samples=1000, seed=seed) for seed in (1, 1, 2))
        assert [one.pairs for one in first.qualified] == [one.pairs for one in again.qualified]
        assert [one.std_mm for one in first.qualified] == [one.std_mm for one in again.qualified]
        assert [one.std_mm for one in first.qualified] != [one.std_mm for one in other.qualified]

    @pytest.mark.parametrize("spots", [0, 3])
    def test_fewer_spots_than_a_sample(self, spots: int, cube: Frame) -> None:
        result = search(np.ones((spots, 2)), cube, 0.15)
        assert result.qualified == []
        assert (result.samples, result.planned) == (0, 0)


class TestOneToOne:
    """A consensus may give a rod several spots and a spot to several rods: the nearest couples are kept."""

    def test_by_hand(self, cube: Frame) -> None:
        """Spot 0 is nearest to rod 0, which may have spot 1 too; rod 1 may have spots 0 and 2, rod 2 only spot 2."""
        start = Pose(np.eye(3), np.array([100.0, 90.0, 3.0]))
        cuts = cut(cube, start.rotation, start.translation).points_mm
        spots = np.array([cuts[0] + [0.1, 0.0], cuts[0] + [0.0, 0.5], cuts[1] + [0.3, 0.0], cuts[3]])
        pairs = ((0, 0), (0, 1), (1, 0), (1, 2), (2, 2), (3, 3))
        found = _one_to_one(Consensus(start.inverse(), pairs, 0.1), cube, spots)
        assert found.tolist() == [0, 2, UNMATCHED, 3, UNMATCHED, UNMATCHED]


class TestCollinearityConstraint:
    @pytest.fixture
    def tried(self, monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """Grows by one with each sample that comes as far as its linear system."""
        count: list[int] = []

        def counted(*given) -> float:
            count.append(1)
            return condition_number(*given)

        monkeypatch.setattr("stereoreg_ros.matching.maurin2009.condition_number", counted)
        return count

    @pytest.mark.parametrize(
        ("least_angle_deg", "constraint_deg", "is_skipped"),
        [(25, 20, False), (15, 20, True), (15, 10, False), (5, 10, True), (5, 0, False), (40, 20, False)],
    )
    def test_skips_flat_triangles(
        self, least_angle_deg: float, constraint_deg: float, is_skipped: bool, cube: Frame, tried: list[int]
    ) -> None:
        """The four triangles of a rectangle have one smallest angle: that of its diagonal."""
        width = 20 / math.tan(math.radians(least_angle_deg))
        four = 100 + np.array([[0, 0], [width, 0], [width, 20], [0, 20]])
        result = search(
            four, cube, 0.15, smallest_sine=math.sin(math.radians(constraint_deg)), max_samples=ARRANGEMENTS
        )
        assert len(tried) == (0 if is_skipped else ARRANGEMENTS)
        # What is skipped was drawn all the same.
        assert result.samples == ARRANGEMENTS

    @pytest.mark.parametrize("spots", [[[0, 0], [10, 10], [20, 20], [0, 30]], [[0, 0], [0, 0], [20, 20], [0, 30]]])
    def test_skips_three_on_one_line_and_two_in_one_place(self, spots, cube: Frame, tried: list[int]) -> None:
        assert search(100 + np.array(spots, dtype=float), cube, 0.15).samples > 0
        assert tried == []

    def test_spares_work(self, cube: Frame, tried: list[int]) -> None:
        spots_mm = SCALE.to_mm(problem(4, cube, false_spots=3).spots_px)
        search(spots_mm, cube, 0.15, smallest_sine=0.0, max_samples=8 * ARRANGEMENTS)
        without = len(tried)
        tried.clear()
        search(spots_mm, cube, 0.15, max_samples=8 * ARRANGEMENTS)
        assert without == 8 * ARRANGEMENTS
        assert 0 < len(tried) < without / 2
