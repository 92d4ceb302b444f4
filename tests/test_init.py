"""What a user finds in the package: its public names, their documentation, and sample images."""

from __future__ import annotations

import dataclasses
import pydoc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mmgsd
from mmgsd.config import OBJECTS
from mmgsd.match.match import Best

PUBLIC = ["Match", "Matcher", "Track", "Tracker", "adapt", "compute_rays", "find_samples", "load", "read_image"]


def test_completion_and_help_show_every_public_name() -> None:
    assert sorted(mmgsd.__all__) == PUBLIC == [name for name in dir(mmgsd) if not name.startswith("_")]
    told = pydoc.plain(pydoc.render_doc(mmgsd))
    assert all(f" {name}(" in told for name in PUBLIC)


def test_the_package_imports_torch_only_where_it_is_used() -> None:
    code = "import sys, mmgsd; dir(mmgsd), mmgsd.compute_rays, mmgsd.find_samples; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("name", PUBLIC)
def test_type_checkers_are_told_of_every_public_name(name: str) -> None:
    package = Path(mmgsd.__file__)
    typed = package.read_text("utf-8").partition("if TYPE_CHECKING:\n")[2].partition("\n\n")[0]
    place = mmgsd._PLACES[name]
    assert any(line.startswith(f"    from mmgsd.{place} import") and name in line for line in typed.splitlines())
    assert getattr(mmgsd, name).__module__ == f"mmgsd.{place}" and package.with_name("py.typed").is_file()


@pytest.mark.parametrize("kind", [mmgsd.Match, mmgsd.Track, Best])
def test_every_field_of_an_answer_is_documented(kind: type) -> None:
    for field in dataclasses.fields(kind):
        assert f"``{field.name}``" in kind.__doc__, field.name


@pytest.mark.parametrize("function", [mmgsd.read_image, mmgsd.Matcher.match, mmgsd.Match, mmgsd])
def test_the_order_of_colours_is_said(function: object) -> None:
    assert "RGB" in function.__doc__ or "red, green, blue" in function.__doc__


@pytest.mark.parametrize("object", OBJECTS)
def test_two_sample_images_of_each_object_can_be_found(object: str) -> None:
    files = mmgsd.find_samples(object)
    first, second = (mmgsd.read_image(path) for path in files)
    assert first.shape == second.shape == {"cloth": (485, 485, 3), "rope": (480, 640, 3)}[object]
    assert not np.array_equal(first, second)


def test_there_are_no_samples_of_other_objects() -> None:
    with pytest.raises(ValueError, match="object must be one of 'cloth', 'rope'.*did you mean 'rope'"):
        mmgsd.find_samples("ropes")
