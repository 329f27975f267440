"""The scenes with mistakes hold the mistakes that they say, and no others."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros import RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import point_line_distances, project
from stereoreg_ros.simulation import ScannerSettings
from stereoreg_ros.simulation.mistakes import (
    HELICAL_SLOPE,
    NO_ROD,
    NOISE_PX,
    TEMPLATE_PITCH_MM,
    Scene,
    SceneGenerator,
    Surroundings,
    collinear,
    contradicted_prior,
    fragments,
    helical,
    mirrored_rod,
    scale_within_tolerance,
    sister,
    template,
    true_scene,
    with_rod_mirrored,
    wrong_spacing,
)

FRAMES = ("cube5", "cube6", "cube8", "zframe", "leksell_ct")
SCENES = 20
# Six standard deviations of a spot's noise.
FAR_PX = 6 * NOISE_PX

GENERATORS: dict[str, SceneGenerator] = {
    "true": true_scene,
    "half_turn": partial(contradicted_prior, turn_deg=180.0),
    "spacing": wrong_spacing,
    "scale": scale_within_tolerance,
    "mirrored_rod": mirrored_rod,
    "helical": helical,
    "template": template,
    "sister": sister,
    "fragments": fragments,
    "collinear": collinear,
}


def around(name: str, max_rotation_deg: float = 30.0) -> Surroundings:
    side = 640 if name == "leksell_ct" else 512
    return Surroundings(ScannerSettings(shape=(side, side)), max_rotation_deg)


def scenes(draw: SceneGenerator, name: str, max_rotation_deg: float = 30.0, count: int = SCENES) -> list[Scene]:
    frame = load_frame(name)
    return [draw(np.random.default_rng([7, index]), frame, around(name, max_rotation_deg)) for index in range(count)]


def own_spots(scene: Scene) -> tuple[Array, NDArray[np.intp]]:
    """The spots of rods, and the rods' rows."""
    made = scene.rods != NO_ROD
    return scene.spots_px[made], scene.rods[made]


def off_truth_px(scene: Scene, frame: Frame | None = None) -> Array:
    """Distances in pixel of the rods' spots from where `frame` (by default the true one) has them at the true pose."""
    frame = frame or scene.true_frame
    assert scene.truth is not None
    assert frame is not None
    spots, rods = own_spots(scene)
    distances: Array = np.linalg.norm(spots - project(frame, scene.truth, around("").scanner.scale)[0][rods], axis=1)
    return distances


def middle(frame: Frame) -> Array:
    ends = np.concatenate([frame.starts, frame.ends])
    middle: Array = (ends.min(axis=0) + ends.max(axis=0)) / 2
    return middle


@pytest.mark.parametrize("kind", GENERATORS)
def test_the_same_seed_gives_the_same_scene(kind: str) -> None:
    frame = load_frame("cube6")
    first, again, other = (GENERATORS[kind](np.random.default_rng(seed), frame, around("cube6")) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.spots_px, again.spots_px)
    np.testing.assert_array_equal(first.rods, again.rods)
    assert first.frame == again.frame
    assert first.spots_px.shape != other.spots_px.shape or not np.allclose(first.spots_px, other.spots_px)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("kind", GENERATORS)
def test_every_generator_on_every_frame(kind: str, name: str) -> None:
    for scene in scenes(GENERATORS[kind], name, count=5):
        assert scene.spots_px.shape == (len(scene.rods), 2)
        assert np.isfinite(scene.spots_px).all()
        assert scene.slice_area_mm2 >= 0.9 * 256.0**2
        assert (scene.truth is None) == (scene.true_frame is None) == (kind == "template")
        assert (scene.previous is not None) == (kind == "fragments")
        if scene.truth is not None and kind != "half_turn":
            assert np.degrees(rotation_angle(scene.truth.rotation)) <= 30.0


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("missing", [0, 1])
def test_true_scenes(name: str, missing: int) -> None:
    drawn = scenes(partial(true_scene, missing=missing), name)
    for scene in drawn:
        _, rods = own_spots(scene)
        assert len(set(rods)) == len(rods) == len(scene.frame) - missing
        assert off_truth_px(scene).max() < FAR_PX
    false = [int((scene.rods == NO_ROD).sum()) for scene in drawn]
    assert max(false) <= 15
    assert len(set(false)) > 5


def test_noise_is_what_it_says() -> None:
    for noise_px in (0.3, 0.6):
        drawn = scenes(partial(true_scene, noise_px=noise_px), "cube8", count=60)
        squares = np.concatenate([off_truth_px(scene) for scene in drawn]) ** 2
        assert np.sqrt(squares.mean() / 2) == pytest.approx(noise_px, rel=0.1)


def test_rod_ends() -> None:
    off = []
    for scene in scenes(partial(true_scene, rod_ends_mm=1.0), "cube8"):
        assert scene.true_frame is not None
        assert off_truth_px(scene).max() < FAR_PX
        off += [scene.true_frame.starts - scene.frame.starts, scene.true_frame.ends - scene.frame.ends]
    assert np.std(off) == pytest.approx(1.0, rel=0.1)
    assert np.mean(off) == pytest.approx(0.0, abs=0.1)


def test_stated_tolerances() -> None:
    (exact,) = scenes(partial(true_scene, stated_mm=0.0, stated_scale=0.0), "zframe", count=1)
    assert exact.frame.tolerances_or(9.0).tolist() == [0.0] * 7
    assert exact.options["scale_tolerance"] == 0.0
    (both,) = scenes(partial(scale_within_tolerance, rod_ends_mm=0.25), "zframe", count=1)
    assert both.frame.tolerances_or(9.0).tolist() == [0.25] * 7
    assert both.options["scale_tolerance"] == 0.002


@pytest.mark.parametrize("turn_deg", [180.0, 90.0])
def test_contradicted_prior(turn_deg: float) -> None:
    for scene in scenes(partial(contradicted_prior, turn_deg=turn_deg), "cube8", 180.0):
        assert scene.truth is not None
        assert scene.options == {"max_rotation_deg": 30.0}
        assert np.degrees(rotation_angle(scene.truth.rotation)) > 45
        x_axis = scene.truth.rotation[:2, 0]
        seen = np.degrees(np.arctan2(x_axis[1], x_axis[0])) % 360
        assert abs(seen - turn_deg) < 35
        assert sorted(scene.rods) == list(range(8))
        assert off_truth_px(scene).max() < FAR_PX


def test_wrong_spacing() -> None:
    factors = []
    for scene in scenes(wrong_spacing, "cube8"):
        assert scene.truth is not None
        factor = np.array([scene.scale.sx, scene.scale.sy]) / 0.5
        factors.append(tuple(np.round(factor, 9)))
        assert scene.slice_area_mm2 == pytest.approx(256.0**2 * factor.prod())
        # At the configured scale the spots are stretched about the true middle.
        spots, rods = own_spots(scene)
        seen = scene.scale.to_mm(spots)
        predicted = project(scene.frame, scene.truth, around("").scanner.scale)[1].points_mm[rods]
        about = (scene.truth @ middle(scene.frame))[:2]
        assert np.abs(seen - (about + factor * (predicted - about))).max() < FAR_PX * 0.53
    assert set(factors) == {(0.95, 1.0), (1.05, 1.0), (1.0, 0.95), (1.0, 1.05)}


def test_scale_within_tolerance() -> None:
    drawn = scenes(scale_within_tolerance, "cube6", count=300)
    factors = np.array([[scene.scale.sx, scene.scale.sy] for scene in drawn]) / 0.5 - 1
    assert factors.std(axis=0) == pytest.approx([0.002, 0.002], rel=0.15)
    assert abs(np.asarray(np.corrcoef(factors.T))[0, 1]) < 0.2
    assert max(off_truth_px(scene).max() for scene in drawn[:20]) < FAR_PX


@pytest.mark.parametrize("name", FRAMES)
def test_mirrored_rod(name: str) -> None:
    mirrored = set()
    for scene in scenes(mirrored_rod, name, 30.0):
        assert scene.true_frame is not None
        assert off_truth_px(scene).max() < FAR_PX
        configured, true = scene.frame, scene.true_frame
        (rod,) = np.flatnonzero((configured.starts != true.starts).any(axis=1))
        mirrored.add(rod)
        assert configured == with_rod_mirrored(true, int(rod))
        lean, true_lean = ((frame.ends - frame.starts)[rod] for frame in (configured, true))
        (axis,) = np.flatnonzero(lean != true_lean)
        assert axis < 2
        assert lean[axis] == -true_lean[axis]
        assert abs(lean[axis]) >= 15
        assert configured.starts[rod, 2] == true.starts[rod, 2]
    assert len(mirrored) >= 2


def test_helical() -> None:
    for scene in scenes(helical, "cube8"):
        assert scene.truth is not None
        spots, rods = own_spots(scene)
        flat = scene.scale.to_mm(spots)
        # Where the spots are on the sloping plane, the rods run through them.
        heights = HELICAL_SLOPE * (flat[:, 1] - 128.0)
        in_frame = scene.truth.inverse() @ np.column_stack([flat, heights])
        frame = scene.frame
        off = np.cross(frame.directions[rods], in_frame) - frame.moments[rods]
        assert np.linalg.norm(off, axis=1).max() < FAR_PX * 0.5
        assert point_line_distances(frame, rods, scene.truth, flat).max() > 0.0


def test_template() -> None:
    counts = set()
    for scene in scenes(template, "zframe", count=60):
        assert scene.truth is None
        assert set(scene.rods) == {NO_ROD}
        counts.add(len(scene.rods))
        spots = scene.scale.to_mm(scene.spots_px)
        # The two holes farthest apart are opposite corners; the others are whole steps from one of them.
        gaps = np.linalg.norm(spots[:, None] - spots, axis=-1)
        first, second = np.unravel_index(gaps.argmax(), gaps.shape)
        assert gaps.max() == pytest.approx(60 * 2**0.5, abs=2.0)
        diagonal = (spots[second] - spots[first]) / gaps.max()
        along = diagonal @ np.array([[1, 1], [-1, 1]]) / 2**0.5
        across = np.array([-along[1], along[0]])
        steps = (spots - spots[first]) @ np.column_stack([along, across]) / TEMPLATE_PITCH_MM
        assert np.abs(steps - np.rint(steps)).max() < 0.3
        assert len({tuple(step) for step in np.abs(np.rint(steps)).astype(int).tolist()}) == len(spots)
        assert np.ptp(np.rint(steps), axis=0).tolist() == [12, 12]
        assert abs((np.degrees(np.arctan2(along[1], along[0])) + 45) % 90 - 45) < 11
    assert min(counts) >= 10
    assert max(counts) <= 28
    assert len(counts) > 8


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("missing", [0, 1])
def test_sister(name: str, missing: int) -> None:
    sides = set()
    for scene in scenes(partial(sister, missing=missing), name):
        spots, rods = own_spots(scene)
        others = scene.spots_px[scene.rods == NO_ROD]
        assert len(set(rods)) == len(rods) == len(scene.frame) - missing
        assert len(others) == len(scene.frame)
        assert off_truth_px(scene).max() < FAR_PX
        low, high = (spots, others) if spots[0, 0] < others[0, 0] else (others, spots)
        sides.add(low is spots)
        assert high[:, 0].min() > low[:, 0].max()
        area_px = scene.slice_area_mm2 / 0.25
        assert area_px / around(name).scanner.shape[0] > high[:, 0].max()
    assert sides == {True, False}


def test_the_sister_is_the_same_frame_within_the_prior() -> None:
    for scene in scenes(sister, "cube8", count=5):
        others = scene.spots_px[scene.rods == NO_ROD]
        result = register_spots(others, scene.frame, scene.scale, RegistrationOptions(max_rotation_deg=30.0))
        assert result
        assert len(result.matches) == 8


def test_fragments() -> None:
    counts, distances = set(), []
    for scene in scenes(fragments, "cube6"):
        assert scene.truth is not None
        assert scene.previous is not None
        pieces = np.bincount(scene.rods, minlength=6)
        assert len(set(pieces)) == 1
        counts.add(pieces[0])
        distances.append(off_truth_px(scene).max() * 0.5)
        shift = np.linalg.norm(scene.previous @ middle(scene.frame) - scene.truth @ middle(scene.frame))
        assert 1.0 <= shift <= 2.0
        turn = rotation_angle(scene.previous.rotation @ scene.truth.rotation.T)
        assert np.degrees(turn) == pytest.approx(1.0)
    assert counts == {3, 4, 5, 6}
    assert max(distances) < 3.0 + FAR_PX * 0.5
    assert max(distances) > 2.0
    assert min(distances) < 1.8
    (alone,) = scenes(partial(fragments, pieces=(2, 2), with_previous=False), "cube6", count=1)
    assert alone.previous is None
    assert np.bincount(alone.rods).tolist() == [2] * 6


def test_fragments_fill_the_disc_evenly() -> None:
    drawn = scenes(partial(fragments, pieces=(6, 6), radius_mm=(20.0, 20.0)), "cube8", count=10)
    shares = np.concatenate([off_truth_px(scene) for scene in drawn]) * 0.5 / 20.0
    # Of the disc's area, as many lie within each share of it.
    np.testing.assert_allclose(np.quantile(shares**2, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.08)


def test_collinear() -> None:
    for scene in scenes(collinear, "cube6"):
        assert scene.truth is not None
        spots = project(scene.frame, scene.truth, scene.scale)[0]
        false = scene.spots_px[scene.rods == NO_ROD]
        assert 4 <= len(false) <= 24
        # Every false spot is on a line through a rod's spot and at least two other false ones.
        for spot in false:
            to_others = false - spot
            along = (spot - spots) / np.linalg.norm(spot - spots, axis=1)[:, None]
            off = np.abs(along[:, None, 0] * to_others[:, 1] - along[:, None, 1] * to_others[:, 0])
            near = np.linalg.norm(to_others, axis=1) < 160
            assert ((off < 2.0) & near).sum(axis=1).max() >= 3
        assert off_truth_px(scene).max() < FAR_PX


def test_random_orders_of_spots() -> None:
    """The first spots are not those of the rods."""
    firsts = [int(scene.rods[0]) for scene in scenes(partial(true_scene, most_false=15), "cube6", count=40)]
    assert NO_ROD in firsts
    assert len(set(firsts)) > 4


def test_no_pose_within_the_prior() -> None:
    with pytest.raises(ValueError, match="frame 'cube6': no pose found within 1 degrees"):
        true_scene(np.random.default_rng(1), load_frame("cube6"), around("cube6", 1.0))
