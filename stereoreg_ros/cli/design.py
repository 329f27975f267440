"""`stereoreg design`: a frame with a small error at a target that can be built, checked for ambiguous poses."""

from __future__ import annotations

import argparse
import shlex
import textwrap
from pathlib import Path
from typing import Final

from tqdm import tqdm

from stereoreg_ros.cli.inspect import USED_OPTIONS, add_slices, draw, inspected
from stereoreg_ros.cli.output import complain, print_line, watched
from stereoreg_ros.cli.parsing import (
    BAD_FILE,
    INTERRUPTED,
    OK,
    Commands,
    WrongCallError,
    add_options,
    given,
    make_folder,
)
from stereoreg_ros.files.whole_file import write_whole
from stereoreg_ros.frames.design_search import Requirements
from stereoreg_ros.frames.expected_error import Imaging
from stereoreg_ros.frames.inspection_table import table_of
from stereoreg_ros.frames.layouts import Envelope
from stereoreg_ros.frames.proposal import Proposal, propose
from stereoreg_ros.geometry.frame_file import frame_text
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import RegistrationOptions

_AXES: Final = (
    "Axes, right-handed: with nominal_orientation 0 0 0 1 x points to the patient's left, y to the back, z to the head "
    "(DICOM's L, P, S) of a patient lying head first, supine."
)


def add_to(commands: Commands) -> None:
    """Add the command."""
    design = commands.add_parser(
        "design",
        help="propose a frame for a target",
        description="Searches for the layout of rods, from the lower face of a box to its upper one, with the smallest "
        "95 %% error at a target, checks it for ambiguous poses with each rod missing in turn, and writes a frame file "
        "with the inspector's report. If interrupted, it writes the best layout so far. Takes a few minutes.",
        allow_abbrev=False,
    )
    design.add_argument("--name", required=True, help="the frame's name, and that of its files")
    design.add_argument("--output", metavar="DIR", type=Path, required=True, help="folder for the files")
    design.add_argument("--lines", metavar="N", type=int, default=6, help="number of rods (default: 6)")
    design.add_argument(
        "--envelope",
        metavar=("X", "Y", "Z"),
        nargs=3,
        type=float,
        default=(60.0, 60.0, 60.0),
        help="the box, mm, centred at the frame's origin (default: 60 60 60)",
    )
    design.add_argument("--diameter", metavar="MM", type=float, default=1.0, help="of the rods, mm (default: 1)")
    design.add_argument(
        "--gap",
        metavar="MM",
        type=float,
        default=5.0,
        help="smallest distance between the surfaces of two rods, mm (default: 5)",
    )
    design.add_argument(
        "--height",
        metavar="MM",
        type=float,
        help="largest distance of a slice from the frame's middle, mm (default: a quarter of the box's height)",
    )
    design.add_argument(
        "--chains", metavar="N", type=int, default=8, help="number of searches, of which the best is kept (default: 8)"
    )
    add_slices(design.add_argument_group("slices"))
    add_options(design.add_argument_group("registration"), RegistrationOptions, USED_OPTIONS)
    design.set_defaults(command=_design)


def _design(arguments: argparse.Namespace) -> int:
    """`stereoreg design`."""
    if not arguments.name.replace("_", "").replace("-", "").isalnum():
        raise WrongCallError(f"--name is {arguments.name!r}, expected letters, digits, '_' and '-'")
    if not 1 <= arguments.chains <= 10_000:
        raise WrongCallError(f"--chains is {arguments.chains}, expected 1 to 10000")
    if arguments.seed < 0:
        raise WrongCallError(f"--seed is {arguments.seed}, expected 0 or more")
    make_folder("--output", arguments.output)
    try:
        options = given(RegistrationOptions, arguments, USED_OPTIONS)
        requirements = _requirements(arguments, options)
        proposal = _proposed(arguments, requirements, options)
    except ValueError as error:
        raise WrongCallError(str(error)) from None
    path = arguments.output / f"{arguments.name}.yaml"
    write_whole(path, frame_text(proposal.frame, _comment(arguments, proposal)))
    print_line(str(path))
    if proposal.interrupted:
        complain(f"interrupted: {path} is the best layout so far, not checked for ambiguous poses")
        return INTERRUPTED
    inspection = inspected(arguments, path)
    report = table_of(inspection)
    write_whole(arguments.output / f"{arguments.name}.txt", "\n".join(report) + "\n")
    draw(inspection, arguments.output / f"{arguments.name}.png")
    for line in report:
        print_line(line)
    if proposal.ambiguous:
        complain(
            f"{path} is the least ambiguous layout found, but still ambiguous: another pose explains "
            f"{proposal.ambiguous} of {proposal.tried} spot sets as well; add rods"
        )
        return BAD_FILE
    return OK


def _requirements(arguments: argparse.Namespace, options: RegistrationOptions) -> Requirements:
    envelope = Envelope(tuple(arguments.envelope), arguments.gap)
    return Requirements(
        envelope,
        (arguments.diameter,) * arguments.lines,
        Imaging.of(PixelScale(*arguments.pixel_spacing), options),
        options.target_in_frame_mm,
        arguments.tilt,
        envelope.size_mm[2] / 4 if arguments.height is None else arguments.height,
    )


def _proposed(arguments: argparse.Namespace, requirements: Requirements, options: RegistrationOptions) -> Proposal:
    with tqdm(total=1.0, leave=False, disable=not watched(), bar_format="{desc} {percentage:3.0f}% |{bar}|") as bar:

        def report(what: str, share: float, least: float) -> bool:
            bar.set_description(f"{what}, {least:.3f} mm", refresh=False)
            bar.n = share
            bar.refresh()
            return True

        return propose(requirements, arguments.name, options, arguments.seed, arguments.chains, report)


def _comment(arguments: argparse.Namespace, proposal: Proposal) -> str:
    """The result, and the call that reproduces it."""
    asked = ["stereoreg", "design"]
    names = ("name", "lines", "envelope", "diameter", "gap", "height", "tilt", "pixel_spacing", *USED_OPTIONS)
    for name in (*names, "chains", "seed"):
        value = getattr(arguments, name)
        if value is not None:
            values = value if isinstance(value, (tuple, list)) else [value]
            asked.append(f"--{name.replace('_', '-')}")
            asked += [f"{one:g}" if isinstance(one, float) else str(one) for one in values]
    found = f"95 % target error {proposal.target_error_95_mm:.3f} mm over the requested slices"
    ending = "interrupted" if proposal.interrupted else f"{proposal.ambiguous} of {proposal.tried} spot sets ambiguous"
    return "\n".join(
        [
            f"{len(proposal.frame)} rods; {found}; {ending}. Made by",
            *textwrap.wrap(shlex.join(asked), 116, break_on_hyphens=False),
            *textwrap.wrap(_AXES, 116),
        ]
    )
