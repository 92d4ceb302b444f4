"""The documents lead somewhere: links, anchors, commands and files exist; what is to be short is short."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
from pathlib import Path

import nbformat
import pandas as pd
import pytest
import tomllib

from mmgsd.__main__ import COMMANDS, _list_studies, make_parser
from mmgsd.report.tables import update_tables
from mmgsd.studies.registry import list_studies

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "data/results/README.md",
                                      "data/results/shipped.md", "data/results/LOG.md")]  # fmt: skip
DOCUMENTS += sorted((ROOT / "docs").glob("*.md"))
PRESENT = [path for path in DOCUMENTS if path.name not in ("CHANGELOG.md", "LOG.md")]  # these tell of the past
SPEAKING = [*PRESENT, ROOT / "Makefile", ROOT / "paper" / "report.tex", *sorted((ROOT / "mmgsd").rglob("*.py")),
            *sorted((ROOT / "mmgsd").rglob("*.js")), *sorted((ROOT / "notebooks").glob("*.ipynb"))]  # fmt: skip
FILLED = [path for path in DOCUMENTS if "made by `make readme`" in path.read_text("utf-8")]
# What the lines of shell in the documents begin with, and what tries them.
TRIED = {
    "make": "test_commands_name_modules_notebooks_and_targets_that_exist, test_makefile.py",
    "papermill": "test_notebooks_have_the_parameters_that_commands_give_them, test_run_all.py",
    "mmgsd": "test_commands_are_parsed",
    "pytest": "this", "ruff": "make lint", "pip": "test_wheel.py, test_extras_exist",
    "git": "needs a network", "http": "Python's own", "cd": "a folder of the reader's",
}  # fmt: skip
LINK = re.compile(r"\]\(([^)\s]+)\)")


def list_anchors(path: Path) -> set[str]:
    """The anchors that GitHub gives a document's headings."""
    headings = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def get_prose(path: Path) -> str:
    """A document without its tables, pictures and marks."""
    text = path.read_text("utf-8")
    return "\n".join(line for line in text.splitlines() if not line.startswith(("|", "![", "<!--")))


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_sections(path: Path) -> None:
    for link in LINK.findall(path.read_text("utf-8")):
        place, _, anchor = link.partition("#")
        if place.startswith("http"):
            continue
        target = path.parent / place if place else path
        assert target.exists(), link
        assert not anchor or anchor in list_anchors(target), link


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_name_modules_notebooks_and_targets_that_exist(path: Path) -> None:
    text = path.read_text("utf-8")
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for module in re.findall(r"python -m (mmgsd[\w.]*)", text):
        assert importlib.util.find_spec(module), module
    for notebook in re.findall(r"notebooks/(\w+\.ipynb)", text):
        assert notebook == "NAME.ipynb" or (ROOT / "notebooks" / notebook).is_file(), notebook
    for target in re.findall(r"(?:^|`)make ([a-z][a-z-]*)", text, re.MULTILINE):
        assert target in targets, target
    for file in re.findall(r"`((?:mmgsd|tests|data/(?:results|sample|weights|objects))/[\w/.]*)`", text):
        assert (ROOT / file).exists(), file


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_notebooks_have_the_parameters_that_commands_give_them(path: Path) -> None:
    command = re.compile(r"papermill notebooks/(\d\w+|your_\w+)\.ipynb out\.ipynb(.*)")
    for notebook, options in command.findall(path.read_text("utf-8")):
        cells = nbformat.read(ROOT / "notebooks" / f"{notebook}.ipynb", 4).cells
        parameters = next(cell.source for cell in cells if "parameters" in cell.metadata.get("tags", []))
        for name in re.findall(r"-p (\w+) ", options):
            assert re.search(rf"^{name} = ", parameters, re.MULTILINE), (notebook, name)
        assert "-p run True" in options or "\nrun = " not in parameters, (notebook, "computes nothing")


SUBSTITUTED = r"\$\((.*?)\)"  # by a shell


def list_lines(path: Path) -> list[str]:
    """The lines of a document's blocks of shell."""
    blocks = re.findall(r"^```(?:sh|bash|shell|console)\n(.*?)^```", path.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.strip()]


def split_command(line: str) -> tuple[str, list[str]]:
    """What a line of shell starts, "mmgsd" say, and its arguments, braces expanded."""
    words = []
    for word in shlex.split(line, comments=True):
        before, braced, after = re.fullmatch(r"(.*?)(?:\{(.*?)\})?([^{}]*)", word).groups()
        words += [word] if braced is None else [f"{before}{choice}{after}" for choice in braced.split(",")]
    if Path(words[0]).name.startswith("python") and words[1] == "-m":
        return words[2], words[3:]
    return Path(words[0]).name, words[1:]


def list_commands(path: Path) -> list[list[str]]:
    """Commands of ours in a document's blocks of shell, and with all their arguments in its sentences."""
    text = path.read_text("utf-8")
    sentences = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    pattern = r"`((?:[^`\s]*python -m )?mmgsd [\w-]+ [^`\n]+)`"
    inline = re.findall(pattern, sentences)
    lines = [line for line in [*list_lines(path), *inline] if "…" not in line and "COMMAND" not in line]
    lines += [command for line in lines for command in re.findall(SUBSTITUTED, line)]
    split = [split_command(re.sub(SUBSTITUTED, "OUTPUT OUTPUT", line)) for line in lines]
    return [words for module, words in split if module == "mmgsd"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_line_of_shell_is_tried_by_no_test(path: Path) -> None:
    for line in list_lines(path):
        assert split_command(line)[0].partition(".")[0] in TRIED, line


@pytest.mark.parametrize("path", PRESENT, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_are_parsed(path: Path) -> None:
    for words in list_commands(path):
        make_parser(words).parse_args(words)


@pytest.mark.parametrize("path", SPEAKING, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_command_that_is_named_exists(path: Path) -> None:
    text = path.read_text("utf-8")
    for command, study in re.findall(r"(?:-m |`)mmgsd ([a-z][\w-]*)(?:(?<=run) ([a-z]\w*))?", text):
        assert study in {"", *_list_studies()} if command == "run" else command in COMMANDS, (command, study)
    for module in re.findall(r"-m mmgsd\.([\w.]+)", text):  # the children's entry points
        assert (ROOT / "mmgsd" / module / "__main__.py").is_file(), module


def test_extras_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    named = re.findall(r"(?:mmgsd|[`'\"]\.)\[([a-z,]+)\]", "".join(path.read_text("utf-8") for path in DOCUMENTS))
    assert named and {extra for names in named for extra in names.split(",")} <= extras.keys()


def test_the_lines_of_python_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    rendered = []
    monkeypatch.setattr("mmgsd.scene.stage.render_dataset", lambda config, *args, **how: rendered.append(config))
    names: dict[str, object] = {}
    for name in ("README.md", "docs/your-photographs.md"):
        text = (ROOT / name).read_text("utf-8")
        for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            exec(block, names)
            if "images" in names:
                names |= {"image0": names["images"][0], "image1": names["images"][1]}
                names["mask1"] = names["image1"].any(-1)
    assert names["match"].joint_weights is not None and len(rendered) == 2


@pytest.mark.parametrize(("name", "words"), [("README.md", 1000), ("data/results/README.md", 1500),
                                             ("data/results/shipped.md", 1200)])
def test_what_is_to_be_short_is_short(name: str, words: int) -> None:
    assert len(get_prose(ROOT / name).split()) <= words


def test_the_readme_has_few_numbers_in_its_sentences() -> None:
    code = re.compile(r"^```.*?^```|\]\([^)]*\)|`[^`]*`", re.DOTALL | re.MULTILINE)
    sentences = code.sub("", get_prose(ROOT / "README.md"))
    assert len(re.findall(r"\d[\d.,]*", sentences)) <= 22


@pytest.mark.parametrize("path", FILLED, ids=lambda path: str(path.relative_to(ROOT)))
def test_make_readme_has_nothing_to_change(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.md"
    copy.write_bytes(path.read_bytes())
    update_tables(copy, ROOT / "data" / "results")
    assert copy.read_text("utf-8") == path.read_text("utf-8")


def test_every_finding_is_short_and_leads_to_a_section() -> None:
    anchors = list_anchors(ROOT / "data" / "results" / "README.md")
    findings = [finding for study in list_studies() for finding in study.findings]
    assert {finding.section for finding in findings} <= set(anchors)
    assert all(len(f"{finding.name} {finding.text}".split()) <= 25 for finding in findings)


@pytest.mark.parametrize("name", ["README.md", "shipped.md"])
def test_a_results_page_says_how_to_read_each_table_in_few_words(name: str) -> None:
    page = (ROOT / "data" / "results" / name).read_text("utf-8")
    sections = page.split("\n## ")[1:]
    for section in sections:
        assert "*The paper*" in section and "```sh" in section, section[:40]
        readout = section.partition("*How to read it*")[2].partition("\n\n")[0]
        assert 0 < len(readout.split()) <= 80, section[:40]


def test_lessons_are_of_commits_and_of_rows_of_their_date() -> None:
    log = (ROOT / "data" / "results" / "LOG.md").read_text("utf-8")
    lessons = re.findall(r"^\| (\d{4}-\d\d-\d\d) \| ([0-9a-f]{7}) \| .+ \|$", log, re.MULTILINE)
    assert len(lessons) == log.count("\n| 20") and lessons == sorted(lessons, key=lambda lesson: lesson[0])
    rows = pd.read_csv(ROOT / "data" / "results" / "experiments.csv")
    ran = set(zip(rows.date, rows.commit.str[:7], strict=True))
    if subprocess.run(["git", "rev-parse", "--is-shallow-repository"], cwd=ROOT, capture_output=True, text=True,
                      check=False).stdout.strip() != "false":  # fmt: skip
        pytest.skip("no history here")
    for date, commit in lessons:
        told = subprocess.run(["git", "log", "-1", "--format=%ad", "--date=short", commit], cwd=ROOT,
                              capture_output=True, text=True, check=True).stdout.strip()  # fmt: skip
        assert (date, commit) in ran or told == date, f"{commit} of {date}"


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_what_notebooks_show_is_shown_as_what_it_is(path: Path) -> None:
    outputs = [output for cell in nbformat.read(path, 4).cells for output in cell.get("outputs", [])]
    for output in outputs:
        data = output.get("data", {})
        assert "|---" not in output.get("text", ""), "Markdown as text"
        assert "Empty DataFrame" not in data.get("text/plain", ""), "an empty table"
        if "the explorer" in data.get("text/plain", ""):
            assert "image/jpeg" in data, "a page that runs nothing shows nothing"


def test_the_interface_names_no_former_names() -> None:
    assert "Deprecated" not in (ROOT / "docs" / "api.md").read_text("utf-8")
