"""Joint answers measured: what is right, what is swapped, and a row that is written from the sample's images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mmgsd.dataset import load_dataset
from mmgsd.measure import joint
from mmgsd.measure.joint import CHOSEN, SWAPS, _measure_swaps, summarise_questions
from mmgsd.studies.joint import main

ROOT = Path(__file__).parents[2]


def test_two_points_that_no_member_explains_together_are_swapped() -> None:
    near = np.array([[True, False, True], [False, True, True]])  # (members, points)
    assert _measure_swaps(near) == pytest.approx(1 / 3)  # the first two; the third goes with either
    assert np.isnan(_measure_swaps(near[:, :1]))


def test_true_matches_are_sorted_as_modes_are(cloth_dataset: Path) -> None:
    data, points = load_dataset(cloth_dataset, "test"), np.array([26, 300, 401, 598])
    found = joint.sort_true_matches(data, (0, 1), points, np.random.default_rng(0))
    true = data.xy[1][np.array(data.group().permutations)[:, points]].transpose(1, 0, 2)  # (S, n, 2)
    assert found.shape == true.shape
    for mine, theirs in zip(found, true, strict=True):  # another order of the same matches
        assert sorted(map(tuple, mine)) == sorted(map(tuple, theirs.astype(float)))
    right = np.abs(found[None] - data.xy[1][np.array(data.group().permutations)[:, points], None]).max(-1) < 1e-3
    assert right.all(1).any(0).all()  # of a flat cloth each column is one member's


def test_a_summary_leaves_out_what_questions_have_not() -> None:
    rows = [dict.fromkeys((*CHOSEN, *SWAPS), value) for value in (0.0, 1.0)]
    rows[0]["swaps_joint"] = float("nan")
    said = summarise_questions(rows)
    assert (said["questions"], said["joint"], said["swaps_joint"]) == (2, 0.5, 1.0)
    assert summarise_questions([{**rows[0], "swaps_joint": float("nan")}])["swaps_joint"] is None


def test_the_command_writes_a_row_and_keeps_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for preset in ("paper", "workspace"):
        place = tmp_path / "data" / "generated" / preset
        place.mkdir(parents=True)
        (place / "rope").symlink_to(ROOT / "data" / "sample" / "rope")
    out = tmp_path / "data" / "results" / "joint.json"
    out.parent.mkdir()
    out.write_text('{"other": {"object": "cloth"}}')
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    monkeypatch.setattr(joint.measure_joint, "__kwdefaults__", {"pairs": 2, "progress": False})
    main("rope")
    rows = json.loads(out.read_text())
    assert list(rows) == ["other", "rope"] and rows["rope"]["paper"]["all"]["questions"] == 6
    assert all(0 <= rows["rope"]["workspace"]["all"][name] <= 1 for name in CHOSEN)
    assert rows["rope"]["milliseconds"]["joint"] > 0
