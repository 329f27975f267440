"""One incoming slice registered, by itself: what it is registered with goes in, results or a reason come out."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.common.conversions import hu_from_image
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.scale_keeper import ScaleInUse
from stereoreg_ros.registration import Registrar, register_frames
from stereoreg_ros.result import Reason, Refusal, Registration


@dataclass(frozen=True, eq=False)
class SliceSetup:
    """What a slice is registered with: a snapshot, so that no change reaches into a registration that is under way.

    previous: scanner_from_frame of each frame on the slice before, None where that was refused.
    """

    settings: NodeSettings
    registrars: tuple[Registrar, ...]
    previous: tuple[Pose | None, ...]
    scale: ScaleInUse


@dataclass(frozen=True, eq=False)
class Registered:
    """A slice that came to registration, and the result of each frame, accepted or refused."""

    ct_slice: Slice
    results: list[Registration | Refusal]
    duration_s: float


@dataclass(frozen=True, eq=False)
class Unusable:
    """A slice that could not be registered: the reason, and a sentence; traceback: of a fault of the program."""

    reason: Reason
    message: str
    duration_s: float = 0.0
    traceback: str = ""


def register_incoming(incoming: IncomingSlice, setup: SliceSetup) -> Registered | Unusable:
    """Register all frames from one slice; whatever is in its image, this returns."""
    started_s = time.perf_counter()
    settings, plane = setup.settings, incoming.plane
    try:
        hu = hu_from_image(incoming.image, settings.rescale_slope, settings.rescale_intercept)
        scanner_from_slice = Pose.identity() if plane is None else plane.scanner_from_slice
        ct_slice = Slice(hu, setup.scale.scale, scanner_from_slice)
        results = register_frames(ct_slice, setup.registrars, settings.options, setup.previous, setup.scale.covariance)
    except ValueError as error:
        return Unusable("bad_image", str(error), time.perf_counter() - started_s)
    except Exception as error:
        message = f"internal error: {type(error).__name__}: {error}; please report it with the node's log"
        return Unusable("internal_error", message, time.perf_counter() - started_s, traceback.format_exc())
    return Registered(ct_slice, results, time.perf_counter() - started_s)
