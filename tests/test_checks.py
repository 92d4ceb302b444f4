"""What is read from a person's hands: flags in their usual spellings, everything else refused by name."""

from __future__ import annotations

import pytest

from mmgsd.checks import read_flag


@pytest.mark.parametrize(("value", "flag"), [
    (True, True), (False, False), ("false", False), ("False", False), (" NO ", False), ("off", False), (0, False),
    ("true", True), ("yes", True), ("1", True), (1, True),
])  # fmt: skip
def test_flags_take_their_usual_spellings(value, flag):
    assert read_flag("overwrite", value) is flag


@pytest.mark.parametrize("value", ["maybe", "", 2, None, [], "truefalse"])
def test_what_is_no_flag_is_refused_by_name(value):
    with pytest.raises(ValueError, match="overwrite must be true or false"):
        read_flag("overwrite", value)
