"""A study is one file: what a new one says is run, shown, judged and compared, and nothing else names it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import mmgsd.studies as studies
from mmgsd.__main__ import main
from mmgsd.paths import Paths
from mmgsd.report import latex, tables, verdict
from mmgsd.studies.registry import load_results

TOY = '''
from mmgsd.measure.evaluation import write_results
from mmgsd.studies.claims import Claim, get, is_at_least
from mmgsd.studies.parameters import check_made
from mmgsd.studies.registry import Finding, Measure, Shown, Study
from mmgsd.studies.table import Column, Table


def check(paths, *, factor=1):
    check_made(paths, "the weather", [paths.root / "sun"])


def run(paths, *, factor=1):
    return write_results({"cloth": {"toy": {"speed": 2.0 * factor}}}, paths.results / "toy.json")


def describe(results):
    return Table("who", {"": [Column("speed", "speed", "speed m/s")]}, {"toy": {"": results["cloth"]["toy"]}})


def judge(results):
    speed = get(results, "toy", "cloth", "toy", "speed")
    return Claim("toy", "Toys are fast.", "Faster than 3 m/s.", f"{speed} m/s", (is_at_least(speed, 3.0),))


STUDY = Study(
    "toy", 999, run, check, "13_toy", ("toy",), tables={"toy": Shown("quick/toy.json", describe, "toy_table")},
    claims=(judge,), compared={"speed": Measure(floor=0.5)},
    findings=(Finding(99, "Toys", ": speed", "toys", lambda results: {"cloth": "4"}),),
)
'''


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A repository, and a file more in the package of the studies."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "toy.py").write_text(TOY)
    (tmp_path / "sun").touch()
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    monkeypatch.setattr(studies, "__path__", [*studies.__path__, str(tmp_path / "package")])
    yield tmp_path
    sys.modules.pop("mmgsd.studies.toy", None)
    vars(studies).pop("toy", None)


def test_a_new_study_is_run_from_a_shell_and_shown(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    main(["run", "toy", "--preset", "quick", "--set", "factor=2"])
    file = Paths(root, "quick").results / "toy.json"
    assert Path(capsys.readouterr().out.strip()) == file and json.loads(file.read_text())["cloth"]["toy"]["speed"] == 4
    study = studies.open_study("toy", "quick")
    assert study.run() is None and study.read() == json.loads(file.read_text())
    assert "| toy | 4.0 |" in study.show("toy").data
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    assert "\n    toy" in capsys.readouterr().out


def test_pages_report_claims_findings_and_verdict_have_a_new_study(root: Path) -> None:
    file = studies.run_study("toy", "quick", factor=2)
    results, page = load_results(file.parent), root / "page.md"
    page.write_text("<!-- toy: made by `make readme` -->\n\n<!-- end of toy -->\n")
    tables.update_tables(page, root / "data" / "results")
    assert "| who | speed m/s |" in page.read_text() and "| toy | 4.0 |" in page.read_text()
    texts = {path.stem: path.read_text() for path in latex.write_report("quick", root)}
    assert "toy & 4.0" in texts["toy_table"] and r"\defresult{verdict/toy}{held}" in texts["results"]
    assert tables.list_claims(results)[-1].verdict == "held"
    assert "| **held** | 4.0 m/s | `13_toy` |" in tables.to_markdown(tables.describe_claims(results))
    found = [finding for study in studies.list_studies() for finding in study.findings]
    assert max(found, key=lambda finding: finding.place).name == "Toys"
    numbers = verdict.compare_numbers(results, {"toy": {"cloth": {"toy": {"speed": 4.6}}}}, Paths(root, "quick"))
    assert numbers.loc["toy", "cloth", "toy", "speed"]["tolerance"] == 0.5


def test_what_a_study_lacks_is_said_before_it_runs_or_shows(root: Path) -> None:
    with pytest.raises(ValueError, match="no data/results/quick/toy.json yet: run 13_toy with run=True"):
        studies.open_study("toy", "quick")
    (root / "sun").unlink()
    for start in (lambda: studies.run_study("toy", "quick"), lambda: studies.open_study("toy", "quick", run=True)):
        with pytest.raises(ValueError, match="run the weather for it first"):
            start()
    assert not (root / "data").exists()


def test_a_study_that_is_none_is_refused_with_the_nearest(root: Path) -> None:
    with pytest.raises(ValueError, match="study must be one of .*did you mean 'toy'"):
        studies.run_study("tay", "quick")
    with pytest.raises(AttributeError, match="tay"):
        _ = studies.tay


def test_names_places_and_markers_are_each_of_one_study() -> None:
    found = studies.list_studies()
    for names in ([study.name for study in found], [study.place for study in found],
                  [name for study in found for name in study.tables],
                  [finding.place for study in found for finding in study.findings]):  # fmt: skip
        assert len(names) == len(set(names))
    assert all(study.results for study in found if study.compared)
