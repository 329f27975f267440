"""The search for a frame: better than chance, buildable, never ambiguous; and what the inspector says of frames."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joblib import parallel_config

from stereoreg_ros import PixelScale, Refusal, Registration, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.cli import main
from stereoreg_ros.frames import ambiguity as ambiguity_module
from stereoreg_ros.frames import design_search as search_module
from stereoreg_ros.frames import proposal as proposal_module
from stereoreg_ros.frames.ambiguity import trials
from stereoreg_ros.frames.design_search import Requirements, random_layouts, search
from stereoreg_ros.frames.expected_error import Imaging
from stereoreg_ros.frames.inspection import inspect_frame
from stereoreg_ros.frames.inspection_table import table_of
from stereoreg_ros.frames.layouts import Envelope, Layouts, gaps
from stereoreg_ros.frames.proposal import propose
from stereoreg_ros.frames.slice_poses import slice_poses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import cut, rod_covariances

SCALE = PixelScale(0.5, 0.5)
OPTIONS = RegistrationOptions(slice_thickness_mm=1.0, target_in_frame_mm=(0.0, 100.0, 0.0))
# Rods where they are drawn, a scale as it is stated, and no limit to the target's error.
PERFECT = replace(OPTIONS, frame_tolerance_mm=0.0, scale_tolerance=0.0, max_target_error_mm=1000.0)


def requirements(rods: int = 6, **changes: Any) -> Requirements:
    asked: dict[str, Any] = {
        "envelope": Envelope((60.0, 60.0, 60.0), 5.0),
        "diameters_mm": (1.0,) * rods,
        "imaging": Imaging(SCALE, 0.3, 1.0),
        "target_mm": (0.0, 100.0, 0.0),
        "largest_tilt_deg": 30.0,
        "largest_height_mm": 15.0,
    }
    return Requirements(**(asked | changes))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Short chains, in this process."""
    monkeypatch.setattr(search_module, "_HOPS", 1)
    monkeypatch.setattr(search_module, "_DESCENT", 12)
    monkeypatch.setattr(proposal_module, "_POSES", 8)
    with parallel_config(backend="sequential"):
        yield


@pytest.mark.usefixtures("quick")
class TestSearch:
    def test_better_than_the_best_of_many_random_layouts(self) -> None:
        asked = requirements()
        found = search(asked, seed=1, chains=1)[0]
        layouts = asked.envelope.layouts(found.corners[None], asked.diameters_mm)
        assert gaps(layouts).min() >= 5.0
        assert asked.target_errors(layouts)[0] == pytest.approx(found.target_error_95_mm)
        drawn = random_layouts(asked, 30, np.random.default_rng(2))
        assert (gaps(asked.envelope.layouts(drawn, asked.diameters_mm)) >= 5.0).all()
        assert found.target_error_95_mm < asked.costs(drawn).min()

    def test_seeded(self) -> None:
        again = [search(requirements(4), seed, chains=1)[0].corners for seed in (1, 1, 2)]
        np.testing.assert_array_equal(again[0], again[1])
        assert not np.array_equal(again[0], again[2])

    @pytest.mark.parametrize("raises", [True, False])
    def test_interrupted_it_keeps_the_best_so_far(self, raises: bool) -> None:
        told: list[float] = []

        def stop(_share: float, least: float) -> bool:
            told.append(least)
            if raises:
                raise KeyboardInterrupt
            return False

        found = search(requirements(4), seed=3, chains=50, progress=stop)[0]
        assert found.interrupted
        assert len(told) == 1
        assert found.target_error_95_mm == pytest.approx(told[0], abs=0.01)

    def test_rods_that_have_no_room(self) -> None:
        crowded = requirements(20, envelope=Envelope((10.0, 10.0, 10.0), 9.0), largest_height_mm=2.0)
        with pytest.raises(ValueError, match="of 20 rods with 9 mm between them hardly any fits into 10 x 10 x 10 mm"):
            search(crowded, seed=0, chains=1)

    @pytest.mark.parametrize(
        ("changes", "told"),
        [
            ({"diameters_mm": (1.0,) * 3}, "lines is 3, expected 4 to 20 rods"),
            ({"diameters_mm": (50.0,) * 6}, "diameter is"),
            ({"largest_tilt_deg": 61.0}, "tilt is 61.0, expected from 0 to 60 degrees"),
            ({"largest_height_mm": 31.0}, "height is 31.0"),
            ({"target_mm": (0.0, np.nan, 0.0)}, "target is"),
        ],
    )
    def test_wrong_wishes(self, changes: dict[str, Any], told: str) -> None:
        with pytest.raises(ValueError, match=told):
            requirements(**changes)

    def test_a_proposal_is_tried_with_each_rod_missing(self) -> None:
        made = propose(requirements(), "mine", PERFECT, seed=4, chains=1)
        assert made.frame.name == "mine"
        assert made.ambiguous == 0
        assert made.tried == 7 * 8
        assert (np.round(made.frame.starts, 1) == made.frame.starts).all()
        assert gaps(Layouts.of(made.frame)).min() >= 5.0


def side_faces() -> Frame:
    """Four diagonals of a cube's side faces, the same after every quarter of a turn."""
    corners = np.array([[-30, -30], [30, -30], [30, 30], [-30, 30]], dtype=float)
    starts = np.column_stack([corners, np.full(4, -30.0)])
    ends = np.column_stack([np.roll(corners, -1, axis=0), np.full(4, 30.0)])
    return Frame("quarters", ("a", "b", "c", "d"), starts, ends, np.ones(4))


class TestInspection:
    def test_a_symmetric_frame_is_ambiguous_and_its_twins_are_named(self) -> None:
        options = replace(PERFECT, max_log10_false_alarms=-1.0, spot_noise_px=0.05)
        found = inspect_frame(side_faces(), options, SCALE, largest_tilt_deg=10.0, count=40)
        record = found.record()
        assert record["outcomes"].get("ambiguous", 0) > 20
        quarter = [twin for twin in record["twins"] if 85 < twin["angle_deg"] < 95]
        assert {twin["rods"] for twin in quarter} >= {"a,b,c,d -> b,c,d,a", "a,b,c,d -> d,a,b,c"}
        assert record["scale_std_percent"]["median"] is None
        assert any("twin" in line for line in table_of(found))

    def test_the_shipped_frame(self) -> None:
        found = inspect_frame(load_frame("cube6"), PERFECT, SCALE, count=30)
        record = json.loads(json.dumps(found.record(), allow_nan=False))
        assert record["poses"] == 30
        assert record["wrong"] == 0
        assert "ambiguous" not in {**record["outcomes"], **record["outcomes_one_rod_missing"]}
        assert sum(record["rods_per_slice"].values()) == pytest.approx(1.0)
        assert min(map(int, record["rods_per_slice"])) >= OPTIONS.min_inliers
        origin, target = record["error_origin_95_mm"], record["error_target_95_mm"]
        assert origin["median"] < target["median"] <= target["95_percent"] <= target["worst"]
        assert np.linalg.norm(record["weakest_axis"]) == pytest.approx(1.0)

    def test_parallel_rods_are_called_by_their_name(self) -> None:
        found = inspect_frame(load_frame("leksell_ct"), RegistrationOptions(max_rotation_deg=30.0), SCALE, count=8)
        assert {"three_coplanar_lines", "fewer_than_three_directions"} <= set(found.singular)

    def test_the_weakest_axis_is_that_of_the_needed_translation(self) -> None:
        """Rods that hardly lean say little of the height."""
        starts = np.array([[-30.0, -30, -30], [30, -30, -30], [30, 30, -30], [-30, 30, -30], [0, 5, -30]])
        ends = starts + np.array([[5.0, 2, 60], [-2, 6, 60], [-6, 1, 60], [3, -5, 60], [4, 4, 60]])
        frame = Frame("upright", tuple("abcde"), starts, ends, np.ones(5))
        found = inspect_frame(frame, PERFECT, SCALE, largest_tilt_deg=5.0, count=10)
        assert abs(found.weakest_axis[2]) > 0.95
        assert found.position_std_mm[2] > 1.5 * found.position_std_mm[:2].max()

    def test_tolerances_make_larger_errors_and_are_told(self) -> None:
        cube = load_frame("cube6")
        own = replace(cube, tolerances_mm=np.array([0.5, 0.5, 0.5, 0.5, 0.5, np.nan]), orientation_required=True)
        options = replace(PERFECT, frame_tolerance_mm=0.1, scale_tolerance=0.004)
        found = [
            inspect_frame(frame, with_these, SCALE, count=4, progress=lambda _share: False)
            for frame, with_these in ((cube, PERFECT), (cube, options), (own, options))
        ]
        perfect, stated, worse = (np.median(one.error_target_mm) for one in found)
        assert perfect < stated < worse
        record = found[2].record()
        assert record["tolerances_mm"] == {**dict.fromkeys("abcde", 0.5), "f": 0.1}
        assert (record["scale_tolerance"], record["orientation_required"]) == (0.004, True)
        tables = ["\n".join(table_of(one)) for one in found]
        assert "rods' ends to 0.1 mm per axis (frame_tolerance_mm), scale to 0.4 %" in tables[1]
        assert "a 0.5, b 0.5, c 0.5, d 0.5, e 0.5, f 0.1 mm per axis (frame file, frame_tolerance_mm)" in tables[2]
        assert "without a nominal orientation the frame is refused" in tables[2]
        assert "orientation" not in tables[1]

    def test_says_that_handedness_cannot_be_seen(self) -> None:
        found = inspect_frame(load_frame("cube6"), PERFECT, SCALE, count=4, progress=lambda _share: False)
        (caution,) = found.record()["cautions"]
        assert caution in table_of(found)
        assert "axes must be right-handed: a mirrored image" in caution

    def test_cut_short(self) -> None:
        found = inspect_frame(load_frame("cube6"), OPTIONS, SCALE, count=20, progress=lambda share: share < 0.3)
        assert 0 < len(found.whole) < 20
        assert not found.one_missing
        assert any("not tried" in line for line in table_of(found))

    def test_a_frame_that_never_shows(self) -> None:
        with pytest.raises(ValueError, match="no slice within 30 degrees shows 7 rods"):
            inspect_frame(load_frame("cube6"), replace(OPTIONS, min_inliers=7), SCALE)

    def test_trials_see_a_missing_rod(self) -> None:
        frame = load_frame("cube6")
        poses = slice_poses(3, 0, np.zeros(3), np.array([0.0, 0.0]), 5.0)
        made = list(trials(frame, poses, SCALE, PERFECT, [None, 2], np.random.default_rng(0)))
        assert [trial.left_out for trial in made] == [None, 2] * 3
        assert all(not trial.reason and trial.right and not trial.twins for trial in made)

    def test_trials_are_of_frames_and_scales_within_the_tolerance(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The spots that the registration is given, over many trials of one pose."""
        frame, options = load_frame("cube6"), replace(OPTIONS, frame_tolerance_mm=0.4, spot_noise_px=0.001)
        one = slice_poses(1, 0, np.zeros(3), np.array([0.0, 0.0]), 0.0)
        poses = one.take(np.zeros(1500, dtype=int))
        refusal = register_spots(np.zeros((0, 2)), frame, SCALE)
        given: list[np.ndarray] = []

        def noted(spots_px: np.ndarray, *_: object, **__: object) -> Registration | Refusal:
            given.append(SCALE.to_mm(spots_px))
            return refusal

        monkeypatch.setattr(ambiguity_module, "register_spots", noted)
        for tolerance_mm, scale_tolerance in ((0.4, 0.0), (0.0, 0.01)):
            given.clear()
            so = replace(options, frame_tolerance_mm=tolerance_mm, scale_tolerance=scale_tolerance)
            list(trials(frame, poses, SCALE, so, [None], np.random.default_rng(1)))
            spots = np.array(given)
            cuts = cut(frame, one.rotations[0], one.translations[0])
            by_rods = np.einsum("nii->ni", rod_covariances(frame, np.full(len(frame), tolerance_mm), cuts))
            np.testing.assert_allclose(spots.mean(axis=0), cuts.points_mm, atol=0.1)
            np.testing.assert_allclose(spots.var(axis=0), by_rods + (scale_tolerance * cuts.points_mm) ** 2, rtol=0.15)


class TestCommands:
    def test_inspect(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        picture = tmp_path / "cube6.png"
        arguments = ["--frame", "cube6", "--poses", "12", "--target-in-frame-mm", "0", "100", "0"]
        assert main(["inspect", *arguments, "--picture", str(picture)]) == 0
        assert "at the target (0, 100, 0)" in capsys.readouterr().out
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert main(["inspect", *arguments, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["target_in_frame_mm"] == [0.0, 100.0, 0.0]

    @pytest.mark.usefixtures("quick")
    def test_design(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        arguments = ["--name", "mine", "--lines", "6", "--chains", "1", "--poses", "4"]
        arguments += ["--frame-tolerance-mm", "0", "--scale-tolerance", "0", "--max-target-error-mm", "1000"]
        assert main(["design", *arguments, "--output", str(tmp_path)]) == 0
        assert "mine: 6 rods" in capsys.readouterr().out
        frame = load_frame(tmp_path / "mine.yaml")
        assert len(frame) == 6
        assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.png", "mine.txt", "mine.yaml"]
        comment = " ".join(line[2:] for line in (tmp_path / "mine.yaml").read_text().splitlines() if line[0] == "#")
        assert "stereoreg design --name mine --lines 6" in comment
        assert "--frame-tolerance-mm 0 --scale-tolerance 0" in comment
        assert "Axes, right-handed" in comment

    @pytest.mark.parametrize(
        ("arguments", "told"),
        [
            (["inspect", "--frame", "nothing"], "frame 'nothing' is neither a file nor a shipped frame"),
            (["inspect", "--frame", "cube6", "--poses", "0"], "--poses is 0, expected 1 to 100000"),
            (["inspect", "--frame", "cube6", "--seed", "-1"], "--seed is -1, expected 0 or more"),
            (["inspect", "--frame", "cube6", "--tilt", "200"], "tilt is 200"),
            (["design", "--name", "a/b", "--output", "OUT"], "--name is 'a/b'"),
            (["design", "--name", "a", "--output", "OUT", "--lines", "2"], "lines is 2, expected 4 to 20 rods"),
            (["design", "--name", "a", "--output", "OUT", "--chains", "0"], "--chains is 0"),
        ],
    )
    def test_wrong_calls(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], told: str
    ) -> None:
        assert main([str(tmp_path) if word == "OUT" else word for word in arguments]) == 2
        assert told in capsys.readouterr().err
        assert not list(tmp_path.iterdir())
