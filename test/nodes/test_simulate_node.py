"""The simulated scanner as a process of its own, over DDS."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.conversions import hu_from_image, pose_from_message
from stereoreg_ros.nodes.scanner.simulate_node import Passage, SimulationSettings
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings
from support.ros_process import NodeProcess, RosClient, node_process


def arguments(**parameters: object) -> list[str]:
    pairs = ((f"-p {name}:={value}").split(" ", 1) for name, value in parameters.items())
    return ["--ros-args", *itertools.chain.from_iterable(pairs)]


@pytest.fixture
def client() -> Iterator[RosClient]:
    with RosClient() as ros:
        yield ros


def run(client: RosClient, **parameters: object) -> tuple[list[Image], list[PoseStamped], NodeProcess]:
    with node_process("simulate_node", *arguments(wait_for_subscriber=True, rate=20.0, **parameters)) as node:
        poses = client.collect(PoseStamped, "true_pose")
        images = client.collect(Image, "image")
        client.wait_for(lambda: not node.running, "the end of the run")
        client.wait_for(lambda: len(images) >= 4 and len(poses) >= 4, "all slices")
        assert node.wait() == 0
    return images, poses, node


def test_slices_with_their_true_poses(client: RosClient) -> None:
    parameters = {"slices": 4, "seed": 5, "columns": 400, "rows": 500, "frame_id": "ct", "register_node": "''"}
    images, poses, _ = run(client, **parameters)
    assert len(images) == len(poses) == 4
    simulation = Passage(load_frame("cube6"), SimulationSettings(seed=5, columns=400, rows=500))
    for image, pose in zip(images, poses, strict=True):
        assert (image.encoding, image.width, image.height, image.step) == ("16SC1", 400, 500, 800)
        assert image.header.frame_id == pose.header.frame_id == "ct"
        assert image.header.stamp == pose.header.stamp
        ct_slice, slice_from_frame = simulation.next_slice()
        assert np.array_equal(hu_from_image(image), ct_slice.hu)
        sent = pose_from_message(pose)
        np.testing.assert_allclose(sent.rotation, slice_from_frame.rotation, atol=1e-12)
        np.testing.assert_allclose(sent.translation, slice_from_frame.translation, atol=1e-9)
    stamps = [image.header.stamp.sec + 1e-9 * image.header.stamp.nanosec for image in images]
    assert (np.diff(stamps) > 0.02).all()


def test_parameters_are_described_and_fixed(client: RosClient) -> None:
    with node_process("simulate_node", *arguments(wait_for_subscriber=True, register_node="''")):
        names = ["frame_file", "rate", "slices", "seed", "false_spots", "noise_hu", "pixel_spacing", "register_node"]
        for descriptor in client.describe_parameters("simulate_node", *names):
            assert descriptor.description
        result = client.set_parameters("simulate_node", noise_hu=3.0)
        assert not result.successful
        assert "noise_hu: the simulation takes its parameters when it starts" in result.reason


def test_a_bad_parameter_ends_it_with_a_sentence() -> None:
    with node_process("simulate_node", *arguments(pixel_spacing="[0.5, -1.0]")) as node:
        assert node.wait() == 1
        assert "cannot start: pixel spacing sy is -1.0, expected a positive number" in node.output
        assert "Traceback" not in node.output


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rate", 0.0),
        ("rate", float("nan")),
        ("slices", -1),
        ("missing_probability", 1.5),
        ("false_spots", 31),
        ("step_mm", 0.0),
        ("pixel_spacing", (0.5,)),
    ],
)
def test_bad_settings_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name} (is|has) .*, expected "):
        SimulationSettings(**{name: value})


def test_settings_reach_the_scanner() -> None:
    settings = SimulationSettings(
        rows=300,
        columns=200,
        pixel_spacing=(0.4, 0.7),
        slice_thickness_mm=2.5,
        noise_hu=7.0,
        false_spots=4,
        needle=True,
        body=False,
    )
    wanted = ScannerSettings(
        (300, 200), PixelScale(0.4, 0.7), 2.5, noise_hu=7.0, false_spots=4, needle=True, body=False
    )
    assert settings.scanner == wanted
    other = replace(settings, needle=False, body=True).scanner
    assert (other.needle, other.body) == (False, True)


class Rendered:
    """What each slice of a passage was made of."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, settings: SimulationSettings, room: bool = True) -> None:
        self.hidden: list[tuple[str, ...]] = []
        self.scanners: list[ScannerSettings] = []
        self._room = room
        monkeypatch.setattr("stereoreg_ros.nodes.scanner.simulate_node.render_slice", self._render)
        simulation = Passage(load_frame("cube6"), settings)
        self.poses = [simulation.next_slice()[1] for _ in range(300)]

    def _render(self, placed: list[PlacedFrame], scanner: ScannerSettings, _rng: object) -> None:
        if scanner.false_spots and not self._room:
            raise ValueError("no room")
        self.hidden.append(placed[0].hidden_lines)
        self.scanners.append(scanner)


def test_as_often_as_asked_for_one_rod_is_missing_and_up_to_so_many_false_spots_are_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = Rendered(monkeypatch, SimulationSettings(missing_probability=0.2, false_spots=3))
    assert {len(one) for one in made.hidden} == {0, 1}
    assert sum(map(len, made.hidden)) / 300 == pytest.approx(0.2, abs=0.07)
    assert {name for one in made.hidden for name in one} == set("abcdef")
    assert {scanner.false_spots for scanner in made.scanners} == {0, 1, 2, 3}
    assert not any(Rendered(monkeypatch, SimulationSettings(missing_probability=0.0)).hidden)


def test_without_room_for_clutter_the_missing_rod_is_missing_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Rendered(monkeypatch, SimulationSettings(missing_probability=1.0, false_spots=30), room=False)
    assert {len(one) for one in made.hidden} == {1}
    assert not any(scanner.false_spots for scanner in made.scanners)


def test_the_frame_moves_by_the_step_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Rendered(monkeypatch, SimulationSettings(step_mm=0.25))
    frame = load_frame("cube6")
    ends = np.concatenate([frame.starts, frame.ends])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
    heights = [(pose @ middle)[2] for pose in made.poses[:40]]
    np.testing.assert_allclose(np.abs(np.diff(heights)), 0.25, atol=1e-9)


def test_image_too_small_for_the_frame() -> None:
    with pytest.raises(ValueError, match="frame 'cube6': no pose found"):
        Passage(load_frame("cube6"), SimulationSettings(rows=32))


def test_passage_of_the_shipped_cube() -> None:
    simulation = Passage(
        load_frame("cube6"), SimulationSettings(seed=2, missing_probability=0.0, false_spots=0, needle=False)
    )
    counts = []
    for _ in range(34):
        ct_slice, _ = simulation.next_slice()
        counts.append(int(cv2.connectedComponents((ct_slice.hu > 1700).astype(np.uint8), connectivity=8)[0]) - 1)
    assert max(counts) == 6
    assert sum(count == 6 for count in counts) > 20
    assert min(counts[:3]) < 6
    assert min(counts[-6:]) < 6


def test_clutter_without_room_is_left_out() -> None:
    settings = SimulationSettings(rows=170, columns=170, false_spots=30, missing_probability=1.0)
    simulation = Passage(load_frame("cube6"), settings)
    for _ in range(3):
        ct_slice, _ = simulation.next_slice()
        assert ct_slice.hu.shape == (170, 170)
