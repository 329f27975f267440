"""Start values for a parameter that nobody declared, or for another node, keep a node from starting."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from support.dicom_files import write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.nodes.common.overrides import require_declared
from stereoreg_ros.nodes.common.parameters import ParameterError
from support.ros_process import NodeProcess

IMAGE = np.zeros((64, 64), np.uint16)


def a_node(name: str = "/register_node", given: tuple[str, ...] = ()) -> Any:
    declared = dict.fromkeys(("max_target_error_mm", "max_rotation_deg", "use_sim_time"))
    return cast(
        "Any",
        SimpleNamespace(
            get_fully_qualified_name=lambda: name, _parameter_overrides=dict.fromkeys(given), _parameters=declared
        ),
    )


def test_what_is_declared_is_taken() -> None:
    require_declared(a_node(given=("max_target_error_mm", "use_sim_time")), [])


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            "max_target_eror_mm",
            "max_target_eror_mm is no parameter of /register_node, did you mean max_target_error_mm?",
        ),
        ("zzz", "zzz is no parameter of /register_node$"),
    ],
)
def test_a_misspelt_name_is_refused_and_the_nearest_is_named(given: str, sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence.replace("?", r"\?")):
        require_declared(a_node(given=("max_rotation_deg", given)), [])


@pytest.mark.parametrize(
    ("name", "content", "is_for_it"),
    [
        ("/register_node", "register_node: {ros__parameters: {a: 1}}", True),
        ("/register_node", "/register_node: {ros__parameters: {a: 1}}", True),
        ("/register_node", "/**: {ros__parameters: {a: 1}}", True),
        ("/ct1/register_node", "/**: {ros__parameters: {a: 1}}", True),
        ("/ct1/register_node", "/**/register_node: {ros__parameters: {a: 1}}", True),
        ("/register_node", "/**/register_node: {ros__parameters: {a: 1}}", True),
        ("/ct1/register_node", "/*/register_node: {ros__parameters: {a: 1}}", True),
        ("/ct1/register_node", "ct1: {register_node: {ros__parameters: {a: 1}}}", True),
        ("/ct1/register_node", "/ct1/register_node: {ros__parameters: {a: 1}}", True),
        ("/register_node", "other: {ros__parameters: {a: 1}}\nregister_node: {ros__parameters: {a: 1}}", True),
        ("/register_node", "", True),
        ("/ct1/register_node", "register_node: {ros__parameters: {a: 1}}", False),
        ("/register_node", "registr_node: {ros__parameters: {a: 1}}", False),
        ("/register_node", "register_node_2: {ros__parameters: {a: 1}}", False),
        ("/ct1/room/register_node", "/*/register_node: {ros__parameters: {a: 1}}", False),
        ("/register_node", "/*/register_node: {ros__parameters: {a: 1}}", False),
    ],
)
def test_a_file_must_be_for_the_node(tmp_path: Path, name: str, content: str, is_for_it: bool) -> None:
    file = tmp_path / "limits.yaml"
    file.write_text(content)
    arguments = ["register_node", "--ros-args", "--params-file", str(file)]
    if is_for_it:
        require_declared(a_node(name), arguments)
        return
    with pytest.raises(ParameterError) as caught:
        require_declared(a_node(name), arguments)
    assert str(caught.value).startswith(f"parameter file {file} has values for /")
    assert f"and none for {name}, expected a section of this node's name" in str(caught.value)


def test_each_file_counts(tmp_path: Path) -> None:
    """Of two files the second is for another node."""
    mine, others = tmp_path / "mine.yaml", tmp_path / "others.yaml"
    mine.write_text("register_node: {ros__parameters: {a: 1}}")
    others.write_text("scanner: {ros__parameters: {a: 1}}")
    with pytest.raises(ParameterError, match=r"others.yaml has values for /scanner and none for /register_node"):
        require_declared(a_node(), ["--ros-args", "--params-file", str(mine), "--params-file", str(others)])


@pytest.mark.parametrize("executable", ["register_node", "receive_dicom_node", "simulate_node", "play_dicom_node"])
def test_no_node_starts_with_a_parameter_that_it_does_not_have(executable: str, tmp_path: Path) -> None:
    folder = ["-p", f"path:={write_slice(tmp_path / 'a.dcm', IMAGE)}"] if executable == "play_dicom_node" else []
    process = NodeProcess(executable, "--ros-args", "-p", "frame_fil:=cube5", *folder)
    try:
        assert process.wait() == 1, process.output
        assert f"cannot start: frame_fil is no parameter of /{executable}" in process.output
        assert "Traceback" not in process.output
    finally:
        process.close()
