"""The picture: which colour is where, and that nothing makes it fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import point_line_distances, project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration

GREEN, YELLOW, RED, BLUE = (80, 220, 80), (60, 210, 255), (70, 70, 255), (255, 170, 60)
FRAME = load_frame("cube6")
SCALE = PixelScale(0.5, 0.5)
POSE = Pose(rotation_exp(np.array([0.1, -0.05, 0.3])), np.array([64.0, 60.0, 3.0]))
MISSING = 2
FALSE_SPOTS = np.array([[20.0, 25.0], [230.0, 220.0]])
HEADER = 64


def a_slice(shape: tuple[int, int] = (256, 256)) -> Slice:
    return Slice(np.random.default_rng(1).normal(40, 20, shape).astype(np.float32), SCALE)


def an_estimate(pose: Pose = POSE) -> tuple[PoseEstimate, Array]:
    """All rods but one matched, half a pixel aside; and all spots."""
    predicted, _ = project(FRAME, pose, SCALE)
    lines = [line for line in range(len(FRAME)) if line != MISSING]
    spots = predicted[lines] + [0.3, -0.4]
    distances = point_line_distances(FRAME, np.array(lines), pose, SCALE.to_mm(spots))
    matches = tuple(
        Match(FRAME.line_names[line], line, k, spots[k], predicted[line], float(distances[k]))
        for k, line in enumerate(lines)
    )
    return PoseEstimate(pose, pose, 1e-4 * np.eye(6), matches, 5.0, -20.0), np.concatenate([spots, FALSE_SPOTS])


def accepted(pose: Pose = POSE, caution: str = "") -> Registration:
    estimate, spots = an_estimate(pose)
    return Registration(FRAME, SliceSpots(spots, SCALE), RegistrationOptions(), estimate, caution)


def count(picture: NDArray[np.uint8], colour: tuple[int, int, int], pixel: Array, zoom: int) -> int:
    """How many pixels of the picture near a pixel of the slice have about a colour: strokes fade at their edges."""
    u, v = np.round(pixel * zoom + (zoom - 1) / 2).astype(int)
    reach = 6 * zoom
    near = picture[max(v + HEADER - reach, 0) : v + HEADER + reach, max(u - reach, 0) : u + reach]
    return int((np.abs(near.astype(int) - colour).max(axis=-1) <= 40).sum())


class TestColours:
    ZOOM = 4

    def test_every_rod_and_spot_has_its_colour_and_no_other(self) -> None:
        result = accepted()
        picture = draw_overlay(a_slice(), result)
        for match in result.matches:
            assert count(picture, GREEN, match.spot_px, self.ZOOM) > 30
            assert count(picture, RED, match.spot_px, self.ZOOM) > 10
            assert count(picture, YELLOW, match.spot_px, self.ZOOM) == 0
        for spot in FALSE_SPOTS:
            assert count(picture, YELLOW, spot, self.ZOOM) > 30
            assert count(picture, GREEN, spot, self.ZOOM) == 0
        missing = project(FRAME, POSE, SCALE)[0][MISSING]
        assert count(picture, BLUE, missing, self.ZOOM) > 30
        assert count(picture, GREEN, missing, self.ZOOM) == 0

    def test_a_residual_is_drawn_from_the_prediction_to_the_side_of_the_spot_ten_times_as_long(self) -> None:
        result = accepted()
        picture = draw_overlay(a_slice(), result)

        def is_red(pixel: Array) -> bool:
            u, v = np.round(pixel * self.ZOOM + (self.ZOOM - 1) / 2).astype(int)
            near = picture[v + HEADER - 1 : v + HEADER + 2, u - 1 : u + 2].astype(int)
            return bool((np.abs(near - RED).max(axis=-1) <= 40).any())

        for match in result.matches:
            residual_px = match.spot_px - match.predicted_px
            assert is_red(match.predicted_px + 9.5 * residual_px)
            assert not is_red(match.predicted_px + 11.5 * residual_px)
            assert not is_red(match.predicted_px - 4 * residual_px)

    def test_a_rod_that_the_slice_does_not_meet_is_not_missed(self) -> None:
        # So far along that rods end before the slice: none of them is inside.
        estimate, spots = an_estimate()
        away = Pose(POSE.rotation, POSE.translation + np.array([0.0, 0.0, 100.0]))
        result = Registration(
            FRAME, SliceSpots(spots, SCALE), RegistrationOptions(), replace(estimate, slice_from_frame=away)
        )
        picture = draw_overlay(a_slice(), result)
        assert (np.abs(picture.astype(int) - BLUE).max(axis=-1) <= 6).sum() == 0

    def test_places_are_those_of_the_pixels_in_an_oblong_image(self) -> None:
        """300 columns of 200 rows, with a shear: what is found to the right of a square image is drawn there."""
        scale = PixelScale(0.5, 0.6, 0.05)
        pose = Pose(POSE.rotation, np.array([135.0, 50.0, 3.0]))
        predicted, _ = project(FRAME, pose, scale)
        (matched, missing) = (0, MISSING)
        assert (predicted[[matched, missing], 0] > 200).all()
        spots = np.array([predicted[matched], [285.0, 180.0]])
        match = Match("a", matched, 0, spots[0], predicted[matched], 0.0)
        estimate = PoseEstimate(pose, pose, 1e-4 * np.eye(6), (match,), 5.0, -20.0)
        ct_slice = Slice(a_slice((200, 300)).hu, scale)
        picture = draw_overlay(ct_slice, Registration(FRAME, SliceSpots(spots, scale), RegistrationOptions(), estimate))
        assert picture.shape == (4 * 200 + HEADER, 4 * 300, 3)
        for place, colour in ((spots[0], GREEN), (spots[1], YELLOW), (predicted[missing], BLUE)):
            assert count(picture, colour, place, self.ZOOM) > 30
        assert count(picture, GREEN, spots[1], self.ZOOM) == 0

    def test_the_headline_says_the_outcome(self) -> None:
        good, doubtful = draw_overlay(a_slice(), accepted()), draw_overlay(a_slice(), accepted(caution="a caution"))
        estimate, spots = an_estimate()
        bad = draw_overlay(a_slice(), Refusal(FRAME, SliceSpots(spots, SCALE), "ambiguous", "two poses", (estimate,)))
        for picture, colour in ((good, GREEN), (doubtful, YELLOW), (bad, RED)):
            # Letters are thin and anti-aliased, how much depends on OpenCV: colours count by their tint.
            text = picture[:HEADER].reshape(-1, 3).astype(float)
            text = text[text.max(axis=1) > 60]
            tint = 255 * text / text.max(axis=1, keepdims=True)
            shares = {
                c: int((np.abs(tint - 255 * np.array(c) / max(c)).max(axis=1) <= 20).sum())
                for c in (GREEN, YELLOW, RED)
            }
            assert shares.pop(colour) > 50
            assert set(shares.values()) == {0}


class TestPicture:
    @pytest.mark.parametrize(
        ("shape", "zoom"), [((256, 256), 4), ((512, 512), 2), ((300, 1024), 1), ((40, 1500), 1), ((600, 700), 2)]
    )
    def test_shape(self, shape: tuple[int, int], zoom: int) -> None:
        picture = draw_overlay(a_slice(shape), accepted())
        assert picture.dtype == np.uint8
        assert picture.shape == (shape[0] * zoom + HEADER, shape[1] * zoom, 3)
        assert picture.shape[1] >= 1024

    @pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 2), (1, 40), (2048, 2048)])
    def test_tiny_and_large_images(self, shape: tuple[int, int]) -> None:
        for result in (accepted(), Refusal(FRAME, SliceSpots(FALSE_SPOTS, SCALE), "no_consensus", "none")):
            picture = draw_overlay(a_slice(shape), result)
            assert picture.ndim == 3
            assert picture.shape[1] >= 1024

    def test_a_refusal_without_explanation_shows_the_spots_alone(self) -> None:
        picture = draw_overlay(a_slice(), Refusal(FRAME, SliceSpots(FALSE_SPOTS, SCALE), "no_consensus", "none"))
        for spot in FALSE_SPOTS:
            assert count(picture, YELLOW, spot, 4) > 30
        for colour in (GREEN, BLUE):
            assert (np.abs(picture.astype(int) - colour).max(axis=-1) <= 6).sum() == 0

    def test_a_refusal_without_spots(self) -> None:
        picture = draw_overlay(a_slice(), Refusal(FRAME, SliceSpots(np.empty((0, 2)), SCALE), "too_few_spots", "none"))
        assert picture[HEADER:].std() > 0
        assert (np.abs(picture.astype(int) - YELLOW).max(axis=-1) <= 6).sum() == 0

    def test_a_refusal_shows_its_best_explanation(self) -> None:
        estimate, spots = an_estimate()
        other, _ = an_estimate(Pose(POSE.rotation, POSE.translation + np.array([30.0, 20.0, 0.0])))
        picture = draw_overlay(
            a_slice(), Refusal(FRAME, SliceSpots(spots, SCALE), "ambiguous", "two poses", (estimate, other))
        )
        for match in estimate.matches:
            assert count(picture, GREEN, match.spot_px, 4) > 30

    @pytest.mark.parametrize("distance", [1e3, 1e6, 1e12])
    def test_predictions_far_outside(self, distance: float) -> None:
        picture = draw_overlay(a_slice(), accepted(Pose(POSE.rotation, np.array([distance, -distance, 3.0]))))
        assert picture.shape == (256 * 4 + HEADER, 1024, 3)

    def test_a_rod_within_the_slice(self) -> None:
        estimate, spots = an_estimate()
        frame = load_frame("leksell_ct")
        lying = Pose(rotation_exp(np.array([np.pi / 2, 0.0, 0.0])), np.zeros(3))
        matches = tuple(match for match in estimate.matches if match.line_index == 1)
        lying_in_it = replace(estimate, slice_from_frame=lying, matches=matches)
        result = Refusal(frame, SliceSpots(spots, SCALE), "degenerate", "-", (lying_in_it,))
        assert draw_overlay(a_slice(), result).shape == (256 * 4 + HEADER, 1024, 3)

    def test_a_flat_image_and_one_spike(self) -> None:
        flat = Slice(np.full((64, 64), 7.0, np.float32), SCALE)
        assert draw_overlay(flat, accepted()).shape[2] == 3
        spike = np.zeros((64, 64), np.float32)
        spike[3, 4] = 60_000
        assert draw_overlay(Slice(spike, SCALE), accepted()).shape[2] == 3

    def test_leaves_the_slice_as_it_is(self) -> None:
        ct_slice = a_slice()
        before = ct_slice.hu.copy()
        draw_overlay(ct_slice, accepted())
        np.testing.assert_array_equal(ct_slice.hu, before)


class TestSeveralFrames:
    """Two frames in one slice, of which the second was not offered all spots."""

    ZOOM = 4
    HEADER = 116

    def results(self) -> tuple[Registration, Registration]:
        first = accepted()
        # The same rods, but for the first, moved by 60 x 50 pixels; its spots are counted from its own first.
        pose = Pose(POSE.rotation, POSE.translation + np.array([30.0, 25.0, 0.0]))
        estimate, spots = an_estimate(pose)
        second = replace(FRAME, name="second")
        return (
            replace(first, spots=SliceSpots(np.concatenate([first.spots_px, spots[: len(estimate.matches)]]), SCALE)),
            Registration(second, SliceSpots(spots[:-1], SCALE), RegistrationOptions(), estimate),
        )

    def near(self, picture: NDArray[np.uint8], colour: tuple[int, int, int], pixel: Array) -> int:
        return count(picture[self.HEADER - HEADER :], colour, pixel, self.ZOOM)

    @pytest.mark.parametrize("backwards", [False, True])
    def test_rods_of_all_frames_are_shown_and_no_frames_rods_are_other_spots(self, backwards: bool) -> None:
        first, second = self.results()
        picture = draw_overlay(a_slice(), [second, first] if backwards else (first, second))
        assert picture.shape == (256 * self.ZOOM + self.HEADER, 1024, 3)
        for result in (first, second):
            for match in result.matches:
                assert self.near(picture, GREEN, match.spot_px) > 30
                assert self.near(picture, RED, match.spot_px) > 10
        for pose in (first.scanner_from_frame, second.scanner_from_frame):
            assert self.near(picture, BLUE, project(FRAME, pose, SCALE)[0][MISSING]) > 30
        for spot in FALSE_SPOTS:
            assert self.near(picture, YELLOW, spot) > 30
        alone = draw_overlay(a_slice(), first)
        others = [match.spot_px for match in second.matches]
        assert all(count(alone, YELLOW, spot, self.ZOOM) > 30 for spot in others)
        # Letters of labels have other colours.
        assert not any(self.near(picture, YELLOW, spot) for spot in others)

    def test_each_has_its_own_headline(self) -> None:
        first, second = self.results()
        refused = Refusal(second.frame, second.spots, "ambiguous", "two poses", (second.estimate,))
        for one, other in ((first, refused), (refused, first)):
            picture = draw_overlay(a_slice(), [one, other])
            head = picture[: self.HEADER].astype(int)
            for rows, result in ((slice(0, 34), one), (slice(58, 86), other)):
                green, red = ((np.abs(head[rows] - c).max(axis=-1) <= 60).sum() for c in (GREEN, RED))
                assert (green > 50, red > 50) == (bool(result), not result)

    def test_labels_name_the_frame_where_there_are_several(self, monkeypatch: pytest.MonkeyPatch) -> None:
        labels: list[str] = []
        monkeypatch.setattr(
            "stereoreg_ros.drawing._label", lambda _picture, _place, _radius, text, _: labels.append(text)
        )
        first, second = self.results()
        draw_overlay(a_slice(), [first, second])
        assert f"cube6 {FRAME.line_names[MISSING]} missing" in labels
        assert f"second {second.matches[0].line} {second.matches[0].residual_mm:.2f} mm" in labels
        assert len(labels) == 2 * len(FRAME)
        labels.clear()
        draw_overlay(a_slice(), [first])
        assert labels[0] == f"{first.matches[0].line} {first.matches[0].residual_mm:.2f} mm"

    def test_one_result_in_a_list_is_drawn_as_by_itself(self) -> None:
        np.testing.assert_array_equal(draw_overlay(a_slice(), [accepted()]), draw_overlay(a_slice(), accepted()))

    def test_without_a_result_there_is_nothing_to_draw(self) -> None:
        with pytest.raises(ValueError, match="found no result to draw"):
            draw_overlay(a_slice(), [])
