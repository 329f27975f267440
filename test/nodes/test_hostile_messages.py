"""Hostile messages and parameters: any fields by hypothesis, and over DDS to a node that has to live on."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from fuzzing.kinds import KINDS
from fuzzing.outcome import outcome_of
from stereoreg_ros.nodes.common.conversions import MessageError, hu_from_image
from stereoreg_ros.nodes.register.parameters import ENTRIES, NodeSettings
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from support.register_bench import SCALE, Bench, assert_near, image_of, rendered
from support.ros_process import RosClient, node_process

QUICK = settings(max_examples=200, deadline=None)
SIZES = st.one_of(st.integers(0, 12), st.sampled_from([8192, 8193, 2**16, 2**31, 2**32 - 1]))
ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=10),
    st.lists(st.floats(), max_size=5).map(tuple),
    st.lists(st.text(max_size=5), max_size=3).map(tuple),
)


def outcome(call: Callable[[], Any], refusal: type[ValueError] = ValueError) -> tuple[Any, str]:
    """What a call returns, or None and what it refused with."""
    try:
        return call(), ""
    except refusal as error:
        # A LinAlgError and a UnicodeError are ValueErrors as well, which nobody raised on purpose.
        return None, str(error) if type(error) is refusal else repr(error)


@QUICK
@given(
    width=SIZES,
    height=SIZES,
    step=SIZES,
    encoding=st.one_of(st.sampled_from(["16SC1", "16UC1", "mono16", "32FC1"]), st.text(max_size=8)),
    big=st.integers(0, 255),
    data=st.binary(max_size=200),
)
def test_any_fields_are_an_image_or_named(
    width: int, height: int, step: int, encoding: str, big: int, data: bytes
) -> None:
    image = Image(height=height, width=width, encoding=encoding, step=step, is_bigendian=big)
    image.data = data
    hu, told = outcome(lambda: hu_from_image(image), MessageError)
    if hu is None:
        assert told.startswith("image ")
    else:
        assert hu.shape == (height, width)
        assert len(data) == step * height


@QUICK
@given(changes=st.dictionaries(st.sampled_from([entry.name for entry in ENTRIES]), ANYTHING, min_size=1, max_size=3))
def test_any_values_are_settings_or_named(changes: dict[str, Any]) -> None:
    """As rclpy lets them through: a value has the type of its parameter, but where that may change."""
    defaults = {entry.name: entry.default for entry in ENTRIES}
    dynamic = {entry.name for entry in ENTRIES if entry.descriptor.dynamic_typing}
    changes = {name: value for name, value in changes.items() if name in dynamic or type(value) is type(defaults[name])}
    settings, told = outcome(lambda: NodeSettings.from_parameters(defaults | changes))
    if settings is None:
        assert any(name in told for name in changes)
    else:
        assert settings.scale is None or settings.scale.sx > 0


@QUICK
@given(data=st.data())
def test_any_python_value_is_an_option_or_named(data: st.DataObject) -> None:
    options = data.draw(st.sampled_from([RegistrationOptions, CalibrationOptions]))
    name = data.draw(st.sampled_from([entry.name for entry in fields(options)]))
    value = data.draw(st.one_of(ANYTHING, st.just(np.ones(3)), st.just({}), st.just(object()), st.complex_numbers()))
    _, told = outcome(lambda: options(**{name: value}))
    assert not told or name in told


def test_malformed_bytes_on_the_wire_leave_the_node_alive() -> None:
    """Not only messages with odd fields, also bytes that are none: what follows them is registered all the same."""
    rng = random.Random(4)
    kind = KINDS["image"]
    spacing = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"
    with (
        RosClient() as client,
        RosClient() as other,
        node_process("register_node", "--ros-args", "-p", spacing) as node,
    ):
        bench = Bench(client)
        bench.warm_up()
        hu, slice_from_frame = rendered(18)
        whole = bytes(serialize_message(image_of(hu)))
        for number in range(30):
            client.publish("image", kind.mutate(rng.choice(kind.seeds()), rng) or b"\0")
            client.publish("image", whole[: rng.randrange(1, len(whole))])
            if number % 10 == 9:
                assert_near(bench.accept(image_of(hu))[0], slice_from_frame)
        # In Fast DDS, a publisher of nothing at all is not heard again; others are.
        other.publish("image", image_of(hu))
        # Until the node knows the other's name, which is the first one's, it is a second source.
        client.wait_for(lambda: bench.is_accepted(image_of(hu)), "poses with the other there")
        other.publish("image", b"")
        assert_near(bench.accept(image_of(hu))[0], slice_from_frame)
        assert node.running


@pytest.mark.parametrize("name", ["image", "parameters"])
def test_any_bytes_do_no_harm(name: str) -> None:
    rng = random.Random(5)
    for _ in range(300):
        tried = outcome_of(KINDS[name], rng.randbytes(rng.randrange(200)))
        assert not tried.finding, tried.details
