"""How dense false spots are where the matched ones lie: as uniform clutter has it, unless there is order in them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.matching.clutter import likeness_to_pieces, matched_densities

SIDE_MM = 256.0
AREA_MM2 = SIDE_MM**2
# Six matched spots of a frame, mm, no three on a line and on no lattice.
OWN = np.array([[100.0, 103.7], [141.3, 96.2], [158.9, 131.4], [137.1, 167.8], [95.6, 158.3], [83.2, 127.9]])
SIX = np.arange(6)


def ratios(others: Array, own: Array = OWN, in_order: bool = True) -> Array:
    """Densities (6,) at the matched spots over that of all spots if they were uniform."""
    spots = np.concatenate([own, others])
    return matched_densities(spots, np.arange(len(own)), AREA_MM2, in_order) / (len(spots) / AREA_MM2)


def uniform(rng: np.random.Generator, count: int) -> Array:
    spots: Array = rng.uniform(0, SIDE_MM, (count, 2))
    return spots


def turned(degrees: float) -> Array:
    angle = math.radians(degrees)
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def holes(pitch_mm: float, degrees: float, side: int) -> Array:
    """A square lattice (side^2, 2) mm about the middle of the slice."""
    steps = (np.arange(side) - (side - 1) / 2) * pitch_mm
    points: Array = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) @ turned(degrees).T
    points += np.array([SIDE_MM / 2 + 1.3, SIDE_MM / 2 - 0.7])
    return points


class TestUniform:
    @pytest.mark.parametrize("count", [4, 14, 40, 120])
    def test_hardly_ever_looks_ordered(self, count: int) -> None:
        """Each of the four kinds of order may be seen once in a hundred slices; so often is half of that found."""
        rng = np.random.default_rng(count)
        sets = 150
        raised = sum(ratios(uniform(rng, count)).max() > 1 + 1e-9 for _ in range(sets))
        print(f"{raised} of {sets} with {count} false spots")
        mean = 0.04 * sets
        assert raised <= mean + 3 * math.sqrt(mean)

    def test_nor_where_the_matched_ones_are_chosen_from_it(self) -> None:
        rng = np.random.default_rng(1)
        sets = 150
        raised = 0
        for _ in range(sets):
            spots = uniform(rng, 26)
            raised += ratios(spots[6:], spots[:6]).max() > 1 + 1e-9
        mean = 0.04 * sets
        assert raised <= mean + 3 * math.sqrt(mean)

    def test_is_as_dense_as_all_spots_are(self) -> None:
        spots = uniform(np.random.default_rng(2), 20)
        np.testing.assert_allclose(matched_densities(spots, np.array([3, 5, 8, 11]), AREA_MM2), 20 / AREA_MM2)

    def test_without_others_too(self) -> None:
        np.testing.assert_allclose(matched_densities(OWN, SIX, AREA_MM2), 6 / AREA_MM2)

    def test_never_less_than_uniform(self) -> None:
        rng = np.random.default_rng(3)
        for count in (1, 2, 3, 30):
            assert ratios(uniform(rng, count) / 3).min() >= 1 - 1e-12

    def test_does_not_depend_on_place_turn_or_order(self) -> None:
        rng = np.random.default_rng(4)
        others = np.concatenate([OWN[:3] + 1.0, OWN[:3] - 1.0, uniform(rng, 9)])
        spots = np.concatenate([OWN, others])
        found = matched_densities(spots, SIX, AREA_MM2)
        assert found.max() > 2 * len(spots) / AREA_MM2
        order = rng.permutation(len(spots))
        moved = (spots[order] - 500.0) @ turned(37.0).T
        rows = np.array([int(np.flatnonzero(order == row)[0]) for row in SIX])
        np.testing.assert_allclose(matched_densities(moved, rows, AREA_MM2), found, rtol=1e-9)


class TestAroundTheFrame:
    def test_by_hand(self) -> None:
        """Four at 10 mm around (50, 50), six unmatched among them, five far off: six where 0.8 are expected."""
        own = np.array([[40.0, 50], [60, 50], [50, 40], [50, 60]])
        among = np.array([[52.0, 51], [48, 49], [51, 47], [53, 53], [47, 52], [49, 54]])
        far = np.array([[200.0 + i, 0] for i in range(5)])
        spots = np.concatenate([own, among, far])
        found = matched_densities(spots, np.arange(4), 1e4, in_order=False)
        np.testing.assert_allclose(found, 6 / (math.pi * 15**2))
        # One there is nothing unusual.
        few = np.concatenate([own, among[:1], far])
        np.testing.assert_allclose(matched_densities(few, np.arange(4), 1e4), len(few) / 1e4)

    def test_counts_even_where_no_order_is_looked_for(self) -> None:
        rng = np.random.default_rng(5)
        crowd = OWN.mean(axis=0) + rng.uniform(-40, 40, (30, 2))
        assert ratios(crowd, in_order=False).min() > 3
        assert ratios(np.concatenate([uniform(rng, 30)]), in_order=False).max() == pytest.approx(1)


class TestClumps:
    @pytest.mark.parametrize("radius_mm", [1.0, 3.0])
    def test_fragments_of_the_rods_spots(self, radius_mm: float) -> None:
        rng = np.random.default_rng(6)
        pieces = (OWN[:, None] + rng.uniform(-0.7, 0.7, (6, 3, 2)) * radius_mm).reshape(-1, 2)
        found = ratios(pieces)
        # Three of them in each circle of 6 mm.
        assert (found >= 3 / (math.pi * 6**2) / (24 / AREA_MM2) - 1e-9).all()
        assert ratios(pieces, in_order=False).max() < found.min()

    def test_three_are_some(self) -> None:
        """Three in six circles of 6 mm, where uniform spots would bring 0.03."""
        np.testing.assert_allclose(ratios(OWN[:3] + 1.0), 3 / (6 * math.pi * 6**2) / (9 / AREA_MM2))

    def test_two_are_none(self) -> None:
        rng = np.random.default_rng(7)
        far = uniform(rng, 8)
        far = far[np.linalg.norm(far[:, None] - OWN, axis=2).min(axis=1) > 15]
        np.testing.assert_allclose(ratios(np.concatenate([OWN[:2] + 1.0, far]))[2:], 1.0)


class TestPieces:
    @pytest.mark.parametrize("count", [1, 3, 12, 48])
    def test_uniform_spots_hardly_ever_look_so(self, count: int) -> None:
        """By more than a thousand to one at most once in a thousand, as a ratio of likelihoods has it."""
        rng = np.random.default_rng(11)
        drawn = (np.concatenate([OWN, uniform(rng, count)]) for _ in range(2000))
        assert sum(likeness_to_pieces(spots, SIX, AREA_MM2) > math.log(1000.0) for spots in drawn) <= 4

    @pytest.mark.parametrize("radius_mm", [0.5, 1.5, 3.0])
    @pytest.mark.parametrize("false", [0, 12])
    def test_pieces_do(self, radius_mm: float, false: int) -> None:
        """One more piece of each spot is enough."""
        rng = np.random.default_rng(12)
        for _ in range(50):
            pieces = OWN + rng.uniform(-radius_mm, radius_mm, OWN.shape)
            spots = np.concatenate([OWN, pieces, uniform(rng, false)])
            assert likeness_to_pieces(spots, SIX, AREA_MM2) > math.log(1000.0)

    def test_by_hand(self) -> None:
        """Two spots, at 3 mm and 20 mm from one matched one and far from another; any share of five may be pieces."""
        own, others = np.array([[50.0, 50.0], [200.0, 200.0]]), np.array([[53.0, 50.0], [50.0, 70.0]])
        student = [
            (1 + squared / 8) ** -2 / (8 * math.pi) for squared in (9.0, 400.0, 147**2 + 150**2, 150**2 + 130**2)
        ]
        beside = [(student[0] + student[2]) / 2, (student[1] + student[3]) / 2]
        likelihoods = [
            math.prod(share * one + (1 - share) / AREA_MM2 for one in beside) * AREA_MM2**2
            for share in (0.1, 0.3, 0.5, 0.7, 0.9)
        ]
        found = likeness_to_pieces(np.concatenate([own, others]), np.array([0, 1]), AREA_MM2)
        assert found == pytest.approx(math.log(sum(likelihoods) / 5))

    def test_no_others_look_like_nothing(self) -> None:
        assert likeness_to_pieces(OWN, SIX, AREA_MM2) == 0.0


# Of a needle's spots along it; none at the matched spot at 0.
STEPS_MM = np.array([-41.3, -30.2, -22.8, -9.1, 12.6, 19.7, 34.9])


class TestLines:
    @pytest.mark.parametrize("degrees", [0.0, 25.0, 90.0, 140.0])
    def test_a_needle_through_two_matched_spots(self, degrees: float) -> None:
        """Only these two lie where its spots do."""
        rng = np.random.default_rng(8)
        own = (OWN - OWN[0]) @ turned(degrees).T + OWN[0]
        along = (own[3] - own[0]) / np.linalg.norm(own[3] - own[0])
        needle = own[0] + STEPS_MM[:, None] * along + rng.normal(0, 0.2, (7, 2))
        found, crowd = ratios(needle, own), ratios(needle, own, in_order=False)
        assert (found[[0, 3]] > 3 * crowd[[0, 3]]).all()
        np.testing.assert_allclose(np.delete(found, [0, 3]), np.delete(crowd, [0, 3]))

    def test_a_row_ends_as_far_beyond_its_last_spot_as_its_spots_are_apart(self) -> None:
        """On its line both matched spots are suspect, the one that may be the next of the row far more."""
        along = (OWN[3] - OWN[0]) / np.linalg.norm(OWN[3] - OWN[0])
        row = OWN[0] + (5.5 * np.arange(1, 6))[:, None] * along
        assert np.linalg.norm(OWN[3] - OWN[0]) > 6 * 5.5 + 5.5 + 2, "beyond the row's end"
        found = ratios(row)
        assert found[0] > 5 * found[3] > 15

    def test_three_spots_by_hand(self) -> None:
        """At 15, 40 and 60 mm on the line through two matched ones 74 mm apart: a row from -7.5 to 82.5 mm."""
        along = (OWN[3] - OWN[0]) / np.linalg.norm(OWN[3] - OWN[0])
        found = ratios(OWN[0] + np.array([[15.0], [40.0], [60.0]]) * along)
        np.testing.assert_allclose(found[[0, 3]], 3 / (1.5 * (45 + 45 + 1.5)) / (9 / AREA_MM2))
        np.testing.assert_allclose(np.delete(found, [0, 3]), 1.0)

    def test_a_needle_beside_them_says_nothing_of_them(self) -> None:
        needle = np.column_stack([np.full(7, 20.0), 40.0 + STEPS_MM])
        np.testing.assert_allclose(ratios(needle), 1.0)

    def test_two_spots_beside_two_matched_ones_are_none(self) -> None:
        along = (OWN[3] - OWN[0]) / np.linalg.norm(OWN[3] - OWN[0])
        np.testing.assert_allclose(ratios(OWN[0] + np.array([[-20.0], [33.0]]) * along), 1.0)


class TestLattices:
    @pytest.mark.parametrize("pitch_mm", [3.0, 5.0, 7.0, 10.0, 20.0])
    @pytest.mark.parametrize("degrees", [0.0, 8.0, 33.0])
    @pytest.mark.parametrize("jitter", [0.0, 0.03])
    def test_matched_spots_on_holes(self, pitch_mm: float, degrees: float, jitter: float) -> None:
        """Of a template with a few needles; jitter as a share of the pitch."""
        rng = np.random.default_rng(round(100 * pitch_mm + degrees))
        for _ in range(3):
            lattice = holes(pitch_mm, degrees, 13 if pitch_mm < 15 else 9)
            chosen = lattice[rng.permutation(len(lattice))[:22]] + rng.normal(0, jitter * pitch_mm, (22, 2))
            found = ratios(chosen[6:], chosen[:6])
            # At a hole it is denser by one over the share of the plane that counts as holes, and more where the
            # template is smaller than the slice.
            assert np.mean(found > 5) > 0.8

    def test_matched_spots_elsewhere_are_not_of_it(self) -> None:
        """Of a true frame over a template one spot in 17 lies on a hole by chance, as large as holes are taken to be.

        The same holes are on finer lattices, too, 1.41, 2, 2.24 and 3 to the pitch; on these more spots would lie.
        """
        rng = np.random.default_rng(9)
        lattice = holes(13.0, 5.0, 13)
        on_holes = 0
        sets = 40
        for _ in range(sets):
            own = 100.0 + rng.uniform(0, 56, (6, 2))
            chosen = lattice[rng.permutation(len(lattice))[:30]]
            on_holes += int((ratios(chosen, own) > 1.5 * ratios(chosen, own, in_order=False)).sum())
        share = 0.24**2
        print(f"{on_holes} of {6 * sets} raised")
        assert on_holes <= 2 * share * 6 * sets

    @pytest.mark.parametrize("seed", [1, 2])
    def test_among_uniform_ones(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        lattice = holes(5.0, 12.0, 13)
        chosen = lattice[rng.permutation(len(lattice))[:26]]
        found = ratios(np.concatenate([chosen[6:], uniform(rng, 10)]), chosen[:6])
        assert np.mean(found > 5) > 0.8

    def test_a_row_of_spots_marks_none(self) -> None:
        """An evenly spaced needle; the matched spots lie where a lattice of its pitch would have holes."""
        needle = np.stack([10.0 * np.arange(14), np.full(14, 30.0)], axis=1)
        own = np.array([[60.0, 90.0], [110.0, 90.0], [140.0, 130.0], [120.0, 170.0], [70.0, 160.0], [40.0, 120.0]])
        np.testing.assert_allclose(ratios(needle, own), ratios(needle, own, in_order=False))

    def test_two_are_none(self) -> None:
        np.testing.assert_allclose(ratios(holes(10.0, 0.0, 13)[[4, 90]]), 1.0)
