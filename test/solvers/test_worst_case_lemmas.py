"""Each step of the proof of the worst cases by itself: true for every pose, and no larger than it has to be.

Sampled poses of whole frames stay far below a bound of many steps; a step that is no longer proven would not show.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.pose_error_bounds import PoseErrorModel, Reach, _Beyond, _second_order

UNIT = PixelScale(1.0, 1.0)
STD_MM = 0.1
NOTHING = np.zeros(3)


class Rod(NamedTuple):
    """A rod along `direction` whose cut is at `arm` mm from the frame's origin, with two more to make a frame."""

    direction: Array
    arm: Array

    @classmethod
    def at(cls, direction: ArrayLike, arm: ArrayLike) -> Rod:
        direction = np.asarray(direction, dtype=np.float64)
        return cls(direction / np.linalg.norm(direction), np.asarray(arm, dtype=np.float64))

    @property
    def frame(self) -> Frame:
        middles = np.array([self.arm, [40.0, 0.0, self.arm[2]], [0.0, 40.0, self.arm[2]]])
        directions = np.array([self.direction, [0.0, 0.6, 0.8], [0.6, 0.0, 0.8]])
        return Frame("rod", tuple("abc"), middles - 90 * directions, middles + 90 * directions, np.ones(3))

    @property
    def pose(self) -> Pose:
        return Pose(np.eye(3), np.array([50.0, 60.0, -self.arm[2]]))

    def model(self, residual_px: ArrayLike = (0.0, 0.0), covariance: Array | None = None) -> PoseErrorModel:
        spots = cut(self.frame, self.pose.rotation, self.pose.translation).points_mm
        spots = spots + np.array([residual_px, [0.0, 0.0], [0.0, 0.0]])
        covariances = np.tile(STD_MM**2 * np.eye(2) if covariance is None else covariance, (3, 1, 1))
        return PoseErrorModel(self.frame, np.arange(3), self.pose, spots, covariances, UNIT)


class Change(NamedTuple):
    """Of the rod, by an error of the pose: what is beyond the first order of its cut, mm; of its slope; of the arm, mm;
    and the slope that it comes to.
    """

    remainder: float
    slope: float
    arm: float
    slope_length: float


def changed(rod: Rod, error: Array) -> Change:
    moved = rod.pose.perturbed(error[:3], error[3:])
    before, after = (cut(rod.frame, one.rotation, one.translation) for one in (rod.pose, moved))
    by_error = after.points_mm[0] - before.points_mm[0]
    slopes = [one.directions[0, :2] / one.directions[0, 2] for one in (before, after)]
    arm_change = np.append(by_error, 0.0) - error[:3]
    return Change(
        float(np.linalg.norm(by_error - cut_jacobian(before, rod.pose.translation)[0] @ error)),
        float(np.linalg.norm(slopes[1] - slopes[0])),
        float(np.linalg.norm(arm_change)),
        float(np.linalg.norm(slopes[1])),
    )


def needed(rod: Rod, error: Array) -> _Beyond | None:
    """What the proof adds for the rods where the first order is that of one error, and the residual's length is one."""
    model = rod.model()
    first = model._first_orders(0.0)
    of = first.functionals
    each = ((of.rotation[None], 2), (of.rise, 1), (of.arm_change, 2), (of.swing, 2), (of.lean, 2), (of.dip, 1))
    sizes = [np.array([np.linalg.norm(np.atleast_2d(row) @ error) for row in part]) for part, _ in each]
    first = first._replace(sizes=type(of)(sizes[0][0], *sizes[1:]), tension=1.0)
    return model._needed(Reach(model, 0.0, _Beyond(NOTHING, NOTHING, NOTHING)), first)


def bounded(rod: Rod, error: Array) -> Change:
    """What is added for the first rod: with a residual of unit length, force is slope's change over the deviation."""
    beyond = needed(rod, error)
    assert beyond is not None
    return Change(float(beyond.remainder[0]), float(beyond.by_slope[0]) * STD_MM, float(beyond.by_arm[0]) * STD_MM, 0.0)


class TestSecondOrderOfATurn:
    def test_holds_for_every_turn_and_arm(self) -> None:
        rng = np.random.default_rng(1)
        for turn in (1e-3, 0.1, 0.8, math.pi / 2):
            for _ in range(50):
                axis, arm = rng.normal(size=(2, 3))
                by = turn * axis / np.linalg.norm(axis)
                true = np.linalg.norm(rotation_exp(by) @ arm - arm - np.cross(by, arm))
                assert true <= float(_second_order(turn, np.array(np.linalg.norm(np.cross(by, arm)))))

    @pytest.mark.parametrize("turn", [1e-3, 0.1, 0.5])
    def test_is_half_the_turn_times_the_swing(self, turn: float) -> None:
        """A point 1 m away from the axis, seen along it: the sagitta of its way and what the way is shorter."""
        true = 1000 * math.hypot(1 - math.cos(turn), turn - math.sin(turn))
        assert true == pytest.approx(float(_second_order(turn, np.array(1000 * turn))), rel=0.02 + turn**2 / 8)


class TestRemainder:
    """By hand: cases in which one part of the bound is all there is, so that it may not be smaller."""

    TURN = 1e-3

    def test_of_an_upright_rod_that_is_carried_about_the_normal(self) -> None:
        rod, error = Rod.at([0, 0, 1], [30.0, 0, 0]), np.array([0, 0, 0, 0, 0, self.TURN])
        true = changed(rod, error).remainder
        assert true == pytest.approx(30 * self.TURN**2 / 2, rel=1e-3)
        assert true <= bounded(rod, error).remainder <= 1.002 * true

    def test_of_a_leaning_rod_it_is_stretched_by_the_slope(self) -> None:
        """The second order of the turn is towards the axis, here along (1, 0, -2): square to the rod."""
        arm = 30 * np.array([1.0, 0.0, -2.0]) / math.sqrt(5)
        rod = Rod.at([2.0, 0.0, 1.0], arm)
        # Lifted by as much as the turn lowers it, the rod is cut where it was.
        error = np.array([0, 0, self.TURN * arm[0], 0, self.TURN, 0])
        true = changed(rod, error).remainder
        assert true == pytest.approx(math.sqrt(5) * 30 * self.TURN**2 / 2, rel=0.01)
        assert true <= bounded(rod, error).remainder <= 1.02 * true

    @pytest.mark.parametrize(
        ("axis", "rise_mm"), [([1.0, 0, 0], 3.0), ([0, 1.0, 0], -3.0), ([0.6, -0.8, 0], 3.0)], ids=["x", "y", "aslant"]
    )
    def test_of_a_rod_that_rises_and_tilts(self, axis: list[float], rise_mm: float) -> None:
        rod = Rod.at([0, 0, 1], [0, 0, 0])
        error = np.array([0, 0, rise_mm, *(self.TURN * np.array(axis))])
        true = changed(rod, error).remainder
        assert true == pytest.approx(3 * self.TURN, rel=1e-3)
        assert true <= bounded(rod, error).remainder <= 1.002 * true

    def test_of_a_rod_that_is_lifted_by_a_tilt_of_the_frame(self) -> None:
        """Far from the frame's origin, a tilt does both: it lifts the rod by arm times turn, and leans it."""
        rod, error = Rod.at([0, 0, 1], [200.0, 0, 0]), np.array([0, 0, 0, 0, self.TURN, 0])
        true = changed(rod, error).remainder
        # The rise by the change of the slope, 0.2 mm by a thousandth; half of it goes back by the turn's second order.
        assert true == pytest.approx(200 * self.TURN**2 / 2, rel=1e-3)
        assert bounded(rod, error).remainder == pytest.approx(1.5 * 200 * self.TURN**2, rel=2e-3)


class TestSlopeAndArm:
    def test_the_slope_of_an_upright_rod_changes_by_the_tilt(self) -> None:
        rod, error = Rod.at([0, 0, 1], [10.0, 0, 0]), np.array([0, 0, 0, 1e-3, 0, 0])
        assert 1e-3 <= changed(rod, error).slope <= bounded(rod, error).slope <= 1.002e-3

    @pytest.mark.parametrize("turn", [1e-3, -1e-3])
    def test_of_a_leaning_rod_by_more(self, turn: float) -> None:
        """tan(a + t) - tan(a) is t (1 + tan(a)^2)."""
        rod, error = Rod.at([2.0, 0, 1.0], [10.0, 0, 0]), np.array([0, 0, 0, 0, turn, 0])
        true = changed(rod, error).slope
        assert true == pytest.approx(5e-3, rel=3e-3)
        assert true <= bounded(rod, error).slope <= 5e-3 * 1.005

    def test_of_a_rod_that_dips_while_it_turns_the_whole_of_the_tilt(self) -> None:
        """A tilt large enough that the rod's share across the slice is smaller after it."""
        rod, error = Rod.at([2.0, 0, 1.0], [10.0, 0, 0]), np.array([0, 0, 0, 0, 0.1, 0])
        true = changed(rod, error).slope
        assert true == pytest.approx(math.tan(math.atan(2) + 0.1) - 2)
        # cos - sin t - t^2 / 2 is what may be left of the rod's share, and t + t^2 / 2 what is added across it.
        cosine, sine = 1 / math.sqrt(5), 2 / math.sqrt(5)
        expected = (0.1 / cosine + 0.005 / cosine) / (cosine - 0.1 * sine - 0.005)
        assert true <= bounded(rod, error).slope == pytest.approx(expected, rel=1e-6)

    def test_the_arm_changes_by_what_the_cut_moves_against_the_frames_origin(self) -> None:
        """A lift moves the cut of a leaning rod by the slope, and the origin out of the slice."""
        rod = Rod.at([2.0, 0, 1.0], [10.0, 0, 0])
        error = np.array([0.3, -0.2, 0.01, 0, 0, 0])
        change, bound = changed(rod, error), bounded(rod, error)
        assert change.arm == pytest.approx(0.01 * math.sqrt(5))
        # The force on a leaning rod is longer than its share in the slice by the slope.
        assert bound.arm == pytest.approx(change.arm * math.sqrt(5), rel=1e-6)
        # How far a frame is shifted in the slice changes nothing at all.
        assert bound.slope == 0.0
        assert bound.remainder == 0.0

    def test_nothing_is_proven_where_the_rod_may_come_to_lie_in_the_slice(self) -> None:
        rod = Rod.at([2.0, 0, 1.0], [10.0, 0, 0])
        # Its share across the slice is 0.447; a turn of 0.4 takes 0.358 and 0.08 of that.
        assert needed(rod, np.array([0, 0, 0, 0, 0.4, 0])) is not None
        assert needed(rod, np.array([0, 0, 0, 0, 0.42, 0])) is None
        upright = Rod.at([0, 0, 1.0], [10.0, 0, 0])
        assert needed(upright, np.array([0, 0, 0, 0, 0, 1.2])) is not None
        assert needed(upright, np.array([0, 0, 0, 0, 0, 1.6])) is None


@pytest.mark.parametrize("size", [1e-3, 0.02, 0.1])
def test_every_part_holds_for_any_rod_and_any_error(size: float) -> None:
    rng = np.random.default_rng(2)
    nearest = np.zeros(3)
    for _ in range(40):
        rod = Rod.at([*rng.uniform(-1.5, 1.5, 2), 1.0], rng.uniform(-40, 40, 3))
        error = size * rng.normal(size=6) * [10.0, 10.0, 10.0, 1.0, 1.0, 1.0]
        beyond = needed(rod, error)
        if beyond is None:
            continue
        true, bound = changed(rod, error), bounded(rod, error)
        # What the change of the arm does, by the force with its share out of the slice.
        found = np.array([true.remainder, true.slope, true.arm * math.hypot(1, true.slope_length)])
        shares = found / np.array(bound[:3])
        assert (shares <= 1 + 1e-9).all()
        nearest = np.maximum(nearest, shares)
    assert (nearest > 0.6).all()


class TestResidual:
    def test_its_length_is_in_standard_deviations(self) -> None:
        """Of errors along and across a diagonal that differ: a residual along it counts little, one across it much."""
        diagonal = np.array([[1.0, -1.0], [1.0, 1.0]]) / math.sqrt(2)
        covariance = diagonal @ np.diag([0.25, 0.01]) @ diagonal.T
        for residual, deviations in (([1.0, 1.0], math.sqrt(2) / 0.5), ([-1.0, 1.0], math.sqrt(2) / 0.1)):
            first = Rod.at([0.3, 0, 1.0], [10.0, 0, 0]).model(residual, covariance)._first_orders(0.0)
            assert first.tension == pytest.approx(deviations)

    def test_the_worst_shift_of_a_spot_is_that_of_a_corner_of_its_box(self) -> None:
        diagonal = np.array([[1.0, -1.0], [1.0, 1.0]]) / math.sqrt(2)
        covariance = diagonal @ np.diag([0.25, 0.01]) @ diagonal.T
        shifts = Rod.at([0.3, 0, 1.0], [10.0, 0, 0]).model((0.0, 0.0), covariance)._first_orders(0.02).shifts
        np.testing.assert_allclose(shifts, 0.02 * math.sqrt(2) / 0.1)

    def test_pixels_that_are_not_square_shift_by_the_longer_side(self) -> None:
        rod = Rod.at([0.3, 0, 1.0], [10.0, 0, 0])
        scale = PixelScale(0.5, 2.0)
        cuts = cut(rod.frame, rod.pose.rotation, rod.pose.translation)
        # A standard deviation of 0.1 mm in x and in y.
        covariances = np.tile(np.diag([0.04, 0.0025]), (3, 1, 1))
        model = PoseErrorModel(rod.frame, np.arange(3), rod.pose, scale.to_px(cuts.points_mm), covariances, scale)
        shifts = model._first_orders(0.02).shifts
        true = math.hypot(0.5, 2.0) * 0.02 / 0.1
        assert (shifts >= true).all()
        np.testing.assert_allclose(shifts, math.sqrt(2) * 2.0 * 0.02 / 0.1)

    def test_shifts_remainders_and_what_the_pose_yields_lengthen_it(self) -> None:
        """All that moves spots away from where the pose has them strains them."""
        model = Rod.at([0, 0, 1], [10.0, 0, 0]).model()
        first = model._first_orders(0.0)._replace(shifts=np.array([3.0, 0.0, 4.0]))
        first = first._replace(sizes=first.sizes._replace(lean=np.full(3, 1e-3)))

        def length(beyond: _Beyond) -> float:
            """Without a residual that was there before: from how much one of unit length adds."""
            without, with_one = (
                model._needed(Reach(model, 0.0, beyond), first._replace(tension=tension)) for tension in (0.0, 1.0)
            )
            assert without is not None
            assert with_one is not None
            return float(without.by_slope[0] / (with_one.by_slope[0] - without.by_slope[0]))

        assert length(_Beyond(NOTHING, NOTHING, NOTHING)) == pytest.approx(5.0)
        # 0.4 mm are four standard deviations.
        assert length(_Beyond(np.array([0.4, 0.0, 0.0]), NOTHING, NOTHING)) == pytest.approx(math.hypot(7.0, 4.0))
        pulled = np.array([30.0, 0.0, 0.0])
        yielded = np.array([model.bound_by_residuals(rows, pulled, NOTHING) for rows in model._jacobian]) / STD_MM
        assert np.linalg.norm(yielded) > 0.1
        assert length(_Beyond(NOTHING, pulled, NOTHING)) == pytest.approx(5.0 + float(np.linalg.norm(yielded)))


class TestWhatThePoseDoes:
    """How shifts and forces of spots move the pose: bounds that some shift, or some force, reaches."""

    ROD = Rod.at([0.5, -0.3, 1.0], [12.0, -7.0, 9.0])

    def test_the_pose_follows_shifts_of_given_lengths(self) -> None:
        model, rng = self.ROD.model(), np.random.default_rng(3)
        lengths = np.array([0.2, 0.7, 0.4])
        row = rng.normal(size=6)
        by_spot = row @ model._gain
        worst = lengths[:, None] * by_spot / np.linalg.norm(by_spot, axis=1, keepdims=True)
        reached = float(np.einsum("ni,ni->", by_spot, worst))
        assert model.follows(row[None], lengths) == pytest.approx(reached)
        three = rng.normal(size=(3, 6))
        for spot in range(3):
            alone = np.where(np.arange(3) == spot, lengths, 0.0)
            _, sizes, directions = np.linalg.svd(three @ model._gain[spot])
            reached = float(np.linalg.norm(three @ model._gain[spot] @ (lengths[spot] * directions[0])))
            assert model.follows(three, alone) == pytest.approx(reached)
            assert reached == pytest.approx(sizes[0] * lengths[spot])

    def test_the_pose_gives_way_to_a_force_out_of_the_slice_at_the_rods_cut(self) -> None:
        """J'f is the force (f, -slope f) and its moment about the frame's origin: checked with the Jacobian itself."""
        model, row = self.ROD.model(), np.random.default_rng(4).normal(size=6)
        cuts = cut(self.ROD.frame, self.ROD.pose.rotation, self.ROD.pose.translation)
        step = np.array([1e-3, 2e-3])
        leaning = cuts.directions.copy()
        leaning[0] = np.append(cuts.directions[0, :2] / cuts.directions[0, 2] + step, 1.0)
        other = cut_jacobian(cuts._replace(directions=leaning), self.ROD.pose.translation)
        change = other[0] - model._jacobian[0]
        # The force along the change of the slope is the worst.
        force = 7.0 * step / np.linalg.norm(step)
        reached = abs(float(row @ model._inverse @ change.T @ force))
        by_slope = np.array([np.linalg.norm(step) * 7.0, 0.0, 0.0])
        assert model.bound_by_residuals(row[None], by_slope, NOTHING) == pytest.approx(reached, rel=1e-6)

    def test_the_pose_gives_way_to_a_change_of_the_arm(self) -> None:
        model, row = self.ROD.model(), np.random.default_rng(5).normal(size=6)
        moment_row = (row @ model._inverse)[3:]
        # The worst change of the arm and force are square to each other and to what the moment is felt about.
        arm_change = np.cross(moment_row, [1.0, 0.0, 0.0])
        arm_change *= 0.03 / np.linalg.norm(arm_change)
        force = np.cross(moment_row, arm_change)
        force *= 5.0 / np.linalg.norm(force)
        reached = abs(float(moment_row @ np.cross(arm_change, force)))
        assert model.bound_by_residuals(row[None], NOTHING, np.array([0.0, 0.15, 0.0])) == pytest.approx(reached)

    def test_both_add_up_for_one_spot_and_in_squares_over_several(self) -> None:
        model, row = self.ROD.model(), np.random.default_rng(6).normal(size=(1, 6))
        slopes, arms = np.diag([0.3, 0.5, 0.2]), np.diag([0.02, 0.01, 0.05])
        each = [
            model.bound_by_residuals(row, slope, NOTHING) + model.bound_by_residuals(row, NOTHING, arm)
            for slope, arm in zip(slopes, arms, strict=True)
        ]
        together = model.bound_by_residuals(row, slopes.sum(axis=0), arms.sum(axis=0))
        assert together == pytest.approx(float(np.linalg.norm(each)))


class TestPointOfTheFrame:
    """A target: what the turn moves it by counts in full, whatever else the error of the pose does there."""

    @staticmethod
    def reach_of(error: Array, pose: Pose) -> Reach:
        """Of a pose that can be carried by `error` or its opposite, and by nothing else."""
        rod = Rod.at([0.5, -0.3, 1.0], [12.0, -7.0, 9.0])
        cuts = cut(rod.frame, pose.rotation, pose.translation)
        covariances = np.tile(0.01 * np.eye(2), (3, 1, 1))
        model = PoseErrorModel(rod.frame, np.arange(3), pose, cuts.points_mm, covariances, UNIT)
        model.sensitivity = np.column_stack([error, np.zeros((6, 5))])
        return Reach(model, 1.0, _Beyond(NOTHING, NOTHING, NOTHING))

    TARGET_MM = np.array([600.0, -640.0, 480.0])  # 1 m away

    @pytest.mark.parametrize("turn", [2e-3, 0.05])
    def test_a_metre_away_the_second_order_of_the_turn_is_not_forgotten(self, turn: float) -> None:
        """To first order the turn and the shift cancel there: the point stays; in truth it does not."""
        pose = Pose(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([50.0, 60.0, -9.0]))
        arm = pose.rotation @ self.TARGET_MM
        axis = np.cross(arm, [0.0, 0.0, 1.0])
        by = turn * axis / np.linalg.norm(axis)
        error = np.append(-np.cross(by, arm), by)
        reach = self.reach_of(error, pose)
        true = max(
            float(np.linalg.norm(pose.perturbed(one[:3], one[3:]) @ self.TARGET_MM - pose @ self.TARGET_MM))
            for one in (error, -error)
        )
        assert true == pytest.approx(1000 * turn**2 / 2, rel=1e-2)
        assert true <= reach.point_mm(self.TARGET_MM) <= 1.01 * true

    def test_a_metre_away_a_turn_of_a_milliradian_is_a_millimetre(self) -> None:
        pose = Pose(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([50.0, 60.0, -9.0]))
        axis = np.cross(pose.rotation @ self.TARGET_MM, [0.0, 0.0, 1.0])
        error = np.append(np.zeros(3), 1e-3 * axis / np.linalg.norm(axis))
        assert self.reach_of(error, pose).point_mm(self.TARGET_MM) == pytest.approx(1.0, rel=1e-3)
        # About the line to it, nothing.
        along = np.append(np.zeros(3), 1e-3 * pose.rotation @ self.TARGET_MM / 1000)
        assert self.reach_of(along, pose).point_mm(self.TARGET_MM) < 1e-9

    def test_what_the_pose_is_carried_beyond_the_first_order_counts_there(self) -> None:
        pose = Pose(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([50.0, 60.0, -9.0]))
        reach = self.reach_of(np.zeros(6), pose)
        model = reach._model
        beyond = _Beyond(np.array([0.01, 0.0, 0.0]), NOTHING, NOTHING)
        moved = model.displacement(self.TARGET_MM)
        carried = model.follows(moved, beyond.remainder)
        assert carried > 0.01
        assert Reach(model, 1.0, beyond).point_mm(self.TARGET_MM) >= carried
