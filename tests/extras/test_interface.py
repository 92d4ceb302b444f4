"""The page of the interface is the docstrings'."""

from __future__ import annotations

import re
from pathlib import Path

import mmgsd
from mmgsd.extras.interface import make_interface

PAGE = Path(__file__).parents[2] / "docs" / "api.md"


def test_the_committed_page_is_what_the_docstrings_make() -> None:
    assert PAGE.read_text("utf-8") == make_interface(), "make readme writes it anew"


def test_each_name_of_the_tables_leads_to_a_section_of_its_own() -> None:
    text = PAGE.read_text("utf-8")
    anchors = [re.sub(r"[^\w-]", "", heading.lower()) for heading in re.findall(r"^### (.*)$", text, re.MULTILINE)]
    assert len(set(anchors)) == len(anchors)
    assert re.findall(r"\]\(#(.*?)\)", text) == anchors


def test_nothing_that_the_package_offers_is_missing() -> None:
    text = PAGE.read_text("utf-8")
    assert [name for name in mmgsd.__all__ if not re.search(rf"^### (mmgsd\.)?{name}$", text, re.MULTILINE)] == []
