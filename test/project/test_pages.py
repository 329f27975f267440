"""The pages beside the README: what they name exists, and the changelog has the form that ROS's tools read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support.dicom_files import ROOT

PAGES = ("CONTRIBUTING.md", "SECURITY.md")
TARGETS = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


@pytest.mark.parametrize("name", PAGES)
def test_what_a_page_names_is_there(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert set(re.findall(r"(?:`|\$ )make ([a-z]+)", text)) <= TARGETS
    for module in re.findall(r"-m (benchmarks[\w.]*)", text):
        assert (ROOT / (module.replace(".", "/") + ".py")).is_file()
    named = [one for one in re.findall(r"`([\w./-]+)`", text) if "/" in one or one.endswith((".md", ".rst", ".xml"))]
    assert named
    # Outside the repository, or made by make.
    gone = [one for one in named if not one.startswith(("../", "install/", "build/")) and not (ROOT / one).exists()]
    assert not gone


def test_the_changelog_is_one_of_ros() -> None:
    """Its title between rows of `^`, then a section for each version, the one to come first, of bullets alone."""
    core, nodes, utils = (
        pytest.importorskip(f"docutils.{name}", reason="docutils is not there") for name in ("core", "nodes", "utils")
    )
    text = Path(ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    title = "Changelog for package stereoreg_ros"
    assert text.startswith(f"{'^' * len(title)}\n{title}\n{'^' * len(title)}\n")
    # No section is lifted into the document's title, and nothing is let pass.
    settings = {"doctitle_xform": False, "halt_level": utils.Reporter.INFO_LEVEL, "report_level": 5}
    document = core.publish_doctree(text, settings_overrides=settings)
    (whole,) = document.children
    versions = [section for section in whole.children if isinstance(section, nodes.section)]
    assert versions[0].children[0].astext() == "Forthcoming"
    for version in versions:
        assert {type(child) for child in version.children[1:]} == {nodes.bullet_list}
