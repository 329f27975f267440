"""Enhanced DICOM images, many frames in one object, as data sets of one frame each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from pydicom import encaps
from pydicom.dataset import Dataset, FileDataset
from pydicom.uid import UID

# What a classic image states at its top level, an enhanced one states in these groups: for all frames, or for each.
_GROUPS: Final = {
    "PixelMeasuresSequence": ("PixelSpacing",),
    "PlanePositionSequence": ("ImagePositionPatient",),
    "PlaneOrientationSequence": ("ImageOrientationPatient",),
    "PixelValueTransformationSequence": ("RescaleSlope", "RescaleIntercept"),
}
_REPLACED: Final = (
    "SharedFunctionalGroupsSequence",
    "PerFrameFunctionalGroupsSequence",
    "NumberOfFrames",
    "PixelData",
    *(keyword for keywords in _GROUPS.values() for keyword in keywords),
)


def single_frames(dataset: Dataset) -> list[Dataset]:
    """A data set for every frame, with spacing, plane and rescale where a classic image has them, and its pixels.

    Raises ValueError where frames and functional groups do not agree, and whatever pydicom raises on damaged elements.
    """
    count = int(dataset.NumberOfFrames)
    per_frame = dataset.PerFrameFunctionalGroupsSequence
    if len(per_frame) != count:
        raise ValueError(f"found {len(per_frame)} items in (5200,9230), expected one for each of {count} frames")
    shared = _only_item(dataset, "SharedFunctionalGroupsSequence")
    syntax = UID(str(dataset.file_meta.TransferSyntaxUID))
    common = {element.tag: element for element in dataset if element.keyword not in _REPLACED}
    frames: list[Dataset] = []
    for groups, pixels in zip(per_frame, _pixels(dataset, count, syntax), strict=True):
        frame: Dataset = FileDataset(
            "",
            dict(common),
            file_meta=dataset.file_meta,
            is_implicit_VR=syntax.is_implicit_VR,
            is_little_endian=syntax.is_little_endian,
        )
        for sequence, keywords in _GROUPS.items():
            group = _only_item(groups, sequence) or (_only_item(shared, sequence) if shared else None)
            for keyword in keywords:
                if group is not None and keyword in group:
                    setattr(frame, keyword, group[keyword].value)
        frame.add_new("PixelData", "OB" if syntax.is_compressed else "OW", pixels)
        frame["PixelData"].is_undefined_length = syntax.is_encapsulated
        frames.append(frame)
    return frames


def single_frame(dataset: Dataset) -> bytes:
    """The compressed image of a data set that holds one; ValueError, or what pydicom raises, where it holds none."""
    for frame in _encapsulated(dataset.PixelData, 1):
        return frame
    raise ValueError("found no compressed image")


def _only_item(dataset: Dataset, keyword: str) -> Dataset | None:
    items: Any = dataset.get(keyword)
    if not items:
        return None
    if len(items) != 1:
        raise ValueError(f"found {len(items)} items in {keyword}, expected one")
    item: Dataset = items[0]
    return item


def _pixels(dataset: Dataset, count: int, syntax: UID) -> Iterator[bytes]:
    """PixelData of each frame, as an image of one frame would have it."""
    data = dataset.PixelData
    if not syntax.is_encapsulated:
        size = dataset.Rows * dataset.Columns * dataset.BitsAllocated // 8
        if len(data) < count * size:
            raise ValueError(f"found {len(data)} bytes of Pixel Data (7FE0,0010), expected {count} * {size}")
        return (data[number * size : (number + 1) * size] for number in range(count))
    return (encaps.encapsulate([frame]) for frame in _encapsulated(data, count))


def _encapsulated(data: bytes, count: int) -> Iterator[bytes]:
    # pydicom 3 renamed it.
    generate: Any = getattr(encaps, "generate_frames", None)
    frames: Iterator[bytes] = (
        generate(data, number_of_frames=count) if generate else encaps.generate_pixel_data_frame(data, count)
    )
    return frames
