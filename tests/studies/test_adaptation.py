"""The study of how many photographs of one's own are needed: what is asked of what, and what is told of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from mmgsd.measure.photographs import Photograph
from mmgsd.paths import Paths
from mmgsd.studies import adaptation
from mmgsd.studies.adaptation import (
    choose_largest,
    describe_adaptation,
    find_most,
    list_cells,
    measure_cell,
    plot_adaptation,
    run,
    tabulate,
)
from mmgsd.studies.table import to_markdown


def make_photographs(**counts: int) -> list[Photograph]:
    return [Photograph(Path(f"{source}{k}.png"), source, np.ones((4, 2)), 100.0, 0.5, True, "corners")
            for source, count in counts.items() for k in range(count)]  # fmt: skip


def test_a_repository_gives_as_many_as_leave_some_to_ask_about() -> None:
    assert [find_most(count) for count in (2, 3, 5, 15, 32)] == [0, 2, 2, 10, 20]
    cells = list(list_cells({"cloth": make_photographs(few=2, some=7)}, splits=2))
    first = [("cloth", "some", kind, count, 0) for kind, count in (("marked", 0), ("marked", 2), ("unmarked", 2),
                                                                   ("marked", 5), ("unmarked", 5))]  # fmt: skip
    assert cells[:5] == first and len(cells) == 10


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """What would have been learnt from and asked about; after two photographs more is found."""
    calls: list[Any] = []

    def adapt(index: Path, weights: str, out: Path, **options: Any) -> Path:
        calls.append(index.read_text())
        if '"corners"' not in calls[-1]:
            raise ValueError("mark some")
        return out

    def ask(matcher: str, sources: list[Photograph], chosen: dict[str, list[Photograph]]) -> dict[str, Any]:
        calls.append([photograph.path.name for photograph in [*sources, *chosen["own"]]])
        better = 0.8 if "adapted" in str(matcher) else 0.6
        return {place: {"name": {"found@5%": better, "spurious": 0.1}} for place in chosen}

    monkeypatch.setattr(adaptation, "adapt", adapt)
    monkeypatch.setattr(adaptation, "_ask", ask)
    monkeypatch.setattr(adaptation, "load", str)
    monkeypatch.setattr(adaptation, "read_adaptation", lambda file: {"rmse_px": {"before": 20.0, "after": 21.0}})
    return calls


def test_no_photograph_is_learnt_from_and_asked_about(asked: list[Any]) -> None:
    photographs = make_photographs(some=5, other=1)
    measure_cell(("cloth", "some", "marked", 2, 3), photographs, steps=4)
    learnt, (*sources, first, second, third) = asked
    assert len(sources) == 2 and all(name in learnt for name in sources)
    assert not any(name in learnt for name in (first, second, third, "other0.png"))


def test_what_is_measured_is_kept_and_told(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(adaptation, "read_photographs", lambda *_: make_photographs(some=5, other=1))
    paths, how = Paths(tmp_path, "paper"), {"folder": "folder", "objects": ["cloth"], "splits": 2, "progress": False}
    results = adaptation.read_results(run(paths, **how))
    assert len(results) == 2 * 3 and results["cloth/some/unmarked/2/0"] == {"refused": "mark some"}
    before = len(asked)
    run(paths, **how)
    assert len(asked) == before
    assert to_markdown(describe_adaptation(results)).splitlines()[2:] == [
        "| cloth, as shipped | 60 % / 10 % | – | 60 % / 10 % | – | +0% |",
        "| cloth, 2 with marks | 80 % / 10 % | – | 80 % / 10 % | – | +5% |",
    ]
    assert set(tabulate(results)["kind"]) == {"marked"}
    (axis,) = plot_adaptation(results).axes
    (line,) = (line for line in axis.lines if line.get_label() == "with marks, by name")
    assert axis.get_title() == "cloth\nsome" and line.get_xydata().tolist() == [[0, 60], [2, 80]]
    assert (tmp_path / "figures" / "adaptation.png").is_file()


def test_the_table_has_equal_photographs_in_all_rows_of_an_object() -> None:
    rows = [("cloth", "large", 0), ("cloth", "large", 2), ("cloth", "large", 5), ("cloth", "small", 0),
            ("cloth", "small", 2), ("rope", "only", 0), ("rope", "only", 2)]  # fmt: skip
    kept = choose_largest(pd.DataFrame(rows, columns=["object", "repository", "count"]))
    assert kept.repository.tolist() == ["large"] * 3 + ["only"] * 2
