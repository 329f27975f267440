"""The transfer syntaxes that can be read here: some need decoders that may not be installed."""

from __future__ import annotations

from typing import Any, Final

import pydicom
from pydicom import uid
from pydicom.uid import UID

# Process 14 with any predictor; the name JPEGLossless differs between pydicom 2 and 3.
JPEG_LOSSLESS: Final = UID("1.2.840.10008.1.2.4.57")
_ALWAYS: Final = (
    uid.ExplicitVRLittleEndian,
    uid.ImplicitVRLittleEndian,
    uid.DeflatedExplicitVRLittleEndian,
    uid.ExplicitVRBigEndian,
)
_COMPRESSED: Final = (
    uid.RLELossless,
    uid.JPEGLosslessSV1,
    JPEG_LOSSLESS,
    uid.JPEGLSLossless,
    uid.JPEG2000Lossless,
    uid.JPEGBaseline8Bit,
    uid.JPEGExtended12Bit,
    uid.JPEGLSNearLossless,
    uid.JPEG2000,
)


def readable() -> tuple[UID, ...]:
    """The transfer syntaxes whose pixels can be decoded with the installed decoders, uncompressed ones first."""
    return (*_ALWAYS, *filter(_has_decoder, _COMPRESSED))


def _has_decoder(syntax: UID) -> bool:
    if int(pydicom.__version__.split(".")[0]) >= 3:
        from pydicom.pixels.decoders.base import get_decoder

        return bool(get_decoder(syntax).is_available)
    handlers: list[Any] = pydicom.config.pixel_data_handlers
    return any(handler.is_available() and handler.supports_transfer_syntax(syntax) for handler in handlers)
