"""The README's table says what the results say."""

import pytest

from mmgsd.tables import BEGIN, END, LABELS, make_results_table, update_readme

RESULTS = {
    object: {method: {"rmse_mean": 10.0 * i + 1, "median": 5.0, "pck@20px": 0.5} for i, method in enumerate(LABELS)}
    for object in ("cloth", "rope")
}


def test_every_method_has_a_row_with_its_numbers() -> None:
    rows = make_results_table(RESULTS).splitlines()
    assert len(rows) == 2 + len(LABELS) + 1
    assert rows[2].startswith("| **MMGSD** (ours) | 1.0 | 5.0 | 50 % | 1.0")
    assert "32.4" in rows[-1] and "31.3" in rows[-1]


def test_update_replaces_only_what_stands_between_the_markers(tmp_path) -> None:
    path = tmp_path / "README.md"
    path.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    update_readme(path, "new")
    assert path.read_text() == f"before\n{BEGIN}\nnew\n{END}\nafter\n"


def test_a_readme_without_markers_is_left_alone(tmp_path) -> None:
    path = tmp_path / "README.md"
    path.write_text("text")
    with pytest.raises(ValueError, match="must hold"):
        update_readme(path, "new")
    assert path.read_text() == "text"
