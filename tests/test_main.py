"""The command line answers in one line, as JSON and as a picture, and says what is wrong."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import sys
import threading
from pathlib import Path

import numpy as np
import onnx
import pandas as pd
import pytest
from PIL import Image

from mmgsd.__main__ import main
from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.images import check_mask
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import Matcher
from mmgsd.match.pair import Pair
from mmgsd.paths import find_samples

CONFIG = TrainConfig(steps=1, batch=2, pairs=2, queries=4, input_px=64, descriptor_dim=4)
SIZES = [(300, 200), (120, 160)]  # of the images


@pytest.fixture(scope="module")
def weights(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_model(CONFIG, cloth_dataset, tmp_path_factory.mktemp("model"), device="cpu", progress=False)


@pytest.fixture(scope="module")
def seeing(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a network with heads, which have learnt as good as nothing."""
    config = dataclasses.replace(CONFIG, heads=True)
    return train_model(config, cloth_dataset, tmp_path_factory.mktemp("seeing"), device="cpu", progress=False)


@pytest.fixture
def masks(tmp_path: Path) -> list[str]:
    """Of each image a mask, the object in its left half."""
    paths = [tmp_path / "masks" / f"{k}.png" for k in (0, 1)]
    paths[0].parent.mkdir()
    for path, (width, height) in zip(paths, SIZES, strict=True):
        grey = np.full((height, width), 100, np.uint8)
        grey[:, : width // 2] = 140
        Image.fromarray(grey).save(path)
    return [str(path) for path in paths]


@pytest.fixture
def frames(images: list[str], tmp_path: Path) -> Path:
    """A folder of three images, of which one is damaged, and of something else."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("a.png", "c.png"):
        Image.open(images[1]).save(folder / name)
    (folder / "b.png").write_bytes(Path(images[0]).read_bytes()[:200])
    (folder / "notes.txt").write_text("of the day")
    return folder


@pytest.fixture
def images(cloth_dataset: Path, tmp_path: Path) -> list[str]:
    """Two files of other sizes and kinds than the training's."""
    data, paths = load_dataset(cloth_dataset), [tmp_path / "a.png", tmp_path / "b.jpg"]
    Image.fromarray(data.load_image(0)).resize(SIZES[0]).convert("RGBA").save(paths[0])
    Image.fromarray(data.load_image(1)).resize(SIZES[1]).save(paths[1])
    return [str(path) for path in paths]


def run(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    main([str(a) for a in arguments])
    return capsys.readouterr().out


def fail(capsys: pytest.CaptureFixture, code: int, *arguments: object) -> str:
    with pytest.raises(SystemExit) as stopped:
        main([str(a) for a in arguments])
    assert stopped.value.code == code
    printed = capsys.readouterr()
    assert not printed.out
    return printed.err


def test_an_answer_is_a_line_a_query(weights, images, capsys):
    out = run(capsys, "match", *images, "--xy", "212,148", "--xy", "10.5,20", "--weights", weights)
    first, second = out.splitlines()
    assert first.startswith("212,148 -> ") and second.startswith("10.5,20 -> ")
    assert first.count("px)") == 4


def test_json_holds_what_the_library_answers(weights, images, capsys):
    (query,) = json.loads(run(capsys, "match", *images, "--xy", "212,148", "--weights", weights, "--n", 2, "--json"))
    pixels = [np.asarray(Image.open(path).convert("RGB")) for path in images]
    answer = Matcher.load(weights).match(*pixels, [(212, 148)], n=2)
    np.testing.assert_allclose([m["xy"] for m in query["modes"]], answer.modes[0], atol=0.01)
    np.testing.assert_allclose([m["spread_px"] for m in query["modes"]], answer.spread_px[0], atol=0.01)
    assert query["entropy"] == pytest.approx(answer.entropy[0], abs=1e-3)


@pytest.mark.parametrize("pixels", [["5,5"], ["5,5", "100,60"]])
def test_the_picture_is_drawn(weights, images, capsys, tmp_path, pixels):
    asked = [word for pixel in pixels for word in ("--xy", pixel)]
    run(capsys, "match", *images, *asked, "--weights", weights, "--out", tmp_path / "new" / "match.png")
    assert Image.open(tmp_path / "new" / "match.png").size[0] > 300


@pytest.mark.parametrize(("changed", "message"), [
    ({"xy": "7"}, "--xy: must be column,row such as 212,148, got '7'"), ({"xy": "a,b"}, "--xy: must be two numbers"),
    ({"xy": "9000,3"}, "inside image0 of 300 x 200 px"), ({"xy": "nan,3"}, "xy must be finite"),
    *(({"--n": n}, f"--n: must be a number from 1 to 64, or auto, got {n!r}") for n in ("0", "65", "²")),
    ({"--weights": "."}, ". is a folder"), ({"--weights": __file__}, "is truncated or no safetensors file"),
    ({"--weights": "towel"}, "towel must be a safetensors file or one of 'cloth', "),
    ({"--out": "match.txt"}, "--out: must end with .png"), ({"image1": "nowhere.png"}, "nowhere.png does not exist"),
    ({"image1": str(Path(__file__).parent)}, "tests holds no image"), ({"--pictures": "there"}, "--pictures must be"),
    ({"--mask1": "nowhere.png"}, "nowhere.png does not exist"), ({"--mask0": __file__}, "is no image"),
    ({"image1": __file__}, "is no image"),
])  # fmt: skip
def test_what_is_wrong_is_said(weights, images, capsys, changed, message):
    options = {"--weights": weights, **{k: v for k, v in changed.items() if k.startswith("--")}}
    words = [word for option in options.items() for word in option]
    arguments = [images[0], changed.get("image1", images[1]), "--xy", changed.get("xy", "5,5"), *words]
    said = fail(capsys, 2, "match", *arguments)
    assert message in said
    assert said.startswith("usage: ") or (said.startswith("error: ") and said.count("\n") == 1)


def test_a_mask_tells_where_the_object_is(weights, images, masks, capsys):
    asked = ["match", *images, "--xy", "10,20", "--xy", "290,20", "--weights", weights]
    asked += ["--mask0", masks[0], "--mask1", masks[1]]
    on, off = run(capsys, *asked).splitlines()
    assert on.count("px)") == 4 and off == "290,20 -> background: the pixel is not on the object (100% sure)"
    on, off = json.loads(run(capsys, *asked, "--json"))
    assert (on["on_object"], on["absent"], on["said"], off["on_object"]) == (1, 0, "", 0)
    assert all(mode["xy"][0] < 80 for mode in on["modes"])
    assert {mode["confidence"] for mode in off["modes"]} == {0}
    assert "background" in off["said"]


def test_pixels_are_answered_together(images, masks, capsys, tmp_path):
    asked = ["match", *images, "--xy", "10,20", "--xy", "30,60", "--weights", "cloth", "--mask0", masks[0]]
    asked += ["--joint", "--csv", tmp_path / "answers.csv", "--json"]
    queries = json.loads(run(capsys, *asked))
    assert [[mode["answer"] for mode in query["modes"]] for query in queries] == [[1, 2, 3, 4]] * 2
    rows = (tmp_path / "answers.csv").read_text().splitlines()
    assert [row.split(",")[3] for row in rows[1:]] == ["1", "2", "3", "4"] * 2


@pytest.mark.parametrize("place", ["one", "folder"])
def test_matches_that_are_seen_come_first_if_asked(images, capsys, place):
    target = images[1] if place == "one" else str(Path(images[1]).parent)
    asked = ["match", images[0], target, "--xy", "10,20", "--weights", "cloth", "--seen-first", "--json"]
    told = json.loads(run(capsys, *asked).splitlines()[-1])
    told = told if place == "one" else told["queries"]
    visible = [mode["visible"] for query in told for mode in query["modes"]]
    assert len(visible) > 1 and visible == sorted(visible, reverse=True)


def test_a_pixel_may_lie_half_a_pixel_outside(weights, images, capsys):
    asked = ["match", *images, "--weights", weights, "--xy"]
    assert run(capsys, *asked, "-0.4,3").startswith("-0.4,3 -> ")
    assert run(capsys, *asked, "3,-.4", "--xy", "-.25,-0.5", "--n", 1).count(" -> ") == 2
    assert "must be two numbers" in fail(capsys, 2, *asked, "-0.4,b")


def test_what_the_terminal_cannot_show_is_spelled(weights, images, monkeypatch):
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, "ascii"))
    main(["match", *images, "--xy", "5,5", "--weights", str(weights)])
    assert printed.getvalue().count(b"(+/-") == 4


@pytest.fixture
def piped_in():
    """Puts bytes where the process reads from, until the test ends."""
    kept = os.dup(0)

    def fill(target: int, content: bytes) -> None:
        with open(target, "wb") as file:
            file.write(content)

    def pipe(content: bytes) -> None:
        source, target = os.pipe()
        os.dup2(source, 0)
        os.close(source)
        threading.Thread(target=fill, args=(target, content)).start()

    yield pipe
    os.dup2(kept, 0)
    os.close(kept)


@pytest.mark.parametrize("name", ["-", "/dev/stdin", "/dev/fd/0"])
@pytest.mark.parametrize("place", [1, 2])
def test_an_image_may_be_piped_in(weights, images, capsys, piped_in, name, place):
    asked = ["match", *images, "--xy", "5,5", "--weights", weights]
    expected = run(capsys, *asked)
    piped_in(Path(asked[place]).read_bytes())
    asked[place] = name
    assert run(capsys, *asked) == expected
    assert "is empty" in fail(capsys, 2, *asked)


def test_a_table_may_be_printed(weights, images, capfd):
    out = run(capfd, "match", *images, "--xy", "5,5", "--weights", weights, "--csv", "/dev/stdout")
    assert out.startswith("image1,x,y,mode") and out.splitlines()[-1].startswith("5,5 -> ")
    assert Path("/dev/stdout").is_symlink()


@pytest.mark.parametrize(("fill", "size", "message"), [
    (255, (160, 120), "must have its image's shape (200, 300), got (120, 160)"), (1, SIZES[0], "brighter than half"),
])  # fmt: skip
def test_another_mask_is_refused(weights, images, capsys, tmp_path, fill, size, message):
    Image.new("L", size, fill).save(tmp_path / "mask.png")
    asked = ["match", *images, "--xy", "5,5", "--weights", weights, "--mask0", tmp_path / "mask.png"]
    said = fail(capsys, 2, *asked)
    assert "mask.png must " in said and message in said


def test_what_the_heads_say_is_printed(seeing, images, capsys, monkeypatch):
    asked = ["match", *images, "--xy", "10,20", "--weights", seeing]
    (query,) = json.loads(run(capsys, *asked, "--json"))
    assert query.keys() >= {"on_object", "absent", "said"} and all(0 <= m["visible"] <= 1 for m in query["modes"])
    for name, value, said in (("absent", 0.9, "absent: image1"), ("on_object", 0.1, "background: "), ("", 0, "hidden")):
        sure = {"absent": np.zeros(1), "on_object": np.ones(1), "visible": np.zeros((1, 4)), name: np.full(1, value)}
        sure.pop("", None)
        monkeypatch.setattr(Pair, "_look", lambda *_, sure=sure: sure)
        assert said in run(capsys, *asked)


def test_a_segmented_image_is_a_mask(seeing, images, capsys, tmp_path, monkeypatch):
    shown = np.zeros(SIZES[0][::-1], np.float32)
    shown[:, :100] = 0.51
    monkeypatch.setattr(Matcher, "segment", lambda *_: shown)
    out = tmp_path / "new" / "mask.png"
    assert "33% of the image" in run(capsys, "segment", images[0], "--out", out, "--weights", seeing)
    np.testing.assert_array_equal(check_mask(out, shown.shape, ""), shown > 0.5)


def test_what_cannot_be_segmented_is_said(weights, images, capsys, tmp_path):
    asked = ["segment", images[0], "--weights", weights, "--out"]
    assert "learnt no mask" in fail(capsys, 2, *asked, tmp_path / "m.png")
    assert "--out must end with .png" in fail(capsys, 2, *asked, "m.jpg")
    assert "--out must not be " in fail(capsys, 2, *asked, images[0])


def test_a_folder_is_answered_for_but_for_what_is_damaged(weights, images, frames, capsys, tmp_path):
    asked = ["match", images[0], frames, "--xy", "5,5", "--xy", "100,60", "--weights", weights, "--json"]
    with pytest.raises(SystemExit) as stopped:
        main([str(a) for a in [*asked, "--csv", tmp_path / "all.csv", "--pictures", tmp_path / "drawn"]])
    printed = capsys.readouterr()
    assert stopped.value.code == 1
    assert "b.png is a damaged image" in printed.err
    assert printed.err.endswith("error: 1 of 3 images could not be answered for: b.png\n")
    lines = [json.loads(line) for line in printed.out.splitlines()]
    assert [line["image1"] for line in lines] == ["a.png", "c.png"]
    alone = json.loads(run(capsys, "match", images[0], frames / "c.png", *asked[3:]))
    assert lines[1]["queries"] == alone
    table = pd.read_csv(tmp_path / "all.csv")
    assert len(table) == 2 * 2 * 4 and table.image1.unique().tolist() == ["a.png", "c.png"]
    expected = [mode["xy"][0] for query in alone for mode in query["modes"]]
    assert table[table.image1 == "c.png"].x1.tolist() == expected
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == ["a.png", "c.png"]


def test_of_a_folder_all_is_answered_that_can_be_read_and_the_rest_is_said(weights, images, frames, capsys, tmp_path):
    (frames / "b.png").unlink()
    others = ["c.jfif", "c.ppm", "c.avif", "c.jp2", os.fsdecode(b"caf\xe9.webp"), "x" * 170 + ".webp"]
    (frames / "empty").mkdir()
    for name in others:
        Image.open(images[1]).convert("RGB").save(frames / name)
    asked = ["match", images[0], frames, "--xy", "5,5", "--weights", weights]
    main([str(a) for a in [*asked, "--csv", tmp_path / "all.csv", "--pictures", tmp_path / "drawn"]])
    printed = capsys.readouterr()
    expected = sorted(["a.png", "c.png", *others])
    spelled = [name.encode("utf-8", "backslashreplace").decode() for name in expected]
    assert [line.split()[0] for line in printed.out.splitlines()] == spelled
    assert "left out" in printed.err and "empty, notes.txt" in printed.err
    assert pd.read_csv(tmp_path / "all.csv").image1.unique().tolist() == spelled
    assert sorted(os.listdir(tmp_path / "drawn")) == [f"{name}.png" for name in expected]  # several are called c


def test_one_image_may_have_a_table_too(seeing, images, capsys, tmp_path):
    out = tmp_path / "new" / "one.csv"
    (query,) = json.loads(run(capsys, "match", *images, "--xy", "5,5", "--weights", seeing, "--csv", out, "--json"))
    table = pd.read_csv(out)
    assert table["mode"].tolist() == [1, 2, 3, 4] and set(table.image1) == {"b.jpg"}
    assert table.visible.tolist() == [mode["visible"] for mode in query["modes"]]
    assert set(table.absent) == {query["absent"]} and set(table.on_object) == {query["on_object"]}


@pytest.mark.parametrize(("words", "message"), [
    ("--out m.png", "--out, --mask0 and --mask1 must be given with one image1"),
    ("--mask1 m.png", "--out, --mask0 and --mask1 must be given with one image1"),
    ("--pictures FRAMES", "--pictures must not be"), ("--csv FRAMES/a.png", "--csv must not be"),
    ("--xy 9000,3", "inside image0 of 300 x 200 px"),
])  # fmt: skip
def test_what_is_wrong_with_a_folder_is_said_at_once(weights, images, frames, capsys, words, message):
    words = words.replace("FRAMES", str(frames)).split()
    asked = ["match", images[0], frames, "--xy", "5,5", "--weights", weights, *words]
    said = fail(capsys, 2, *asked)
    assert message in said and "skipped" not in said


@pytest.fixture
def marked(images, tmp_path) -> Path:
    """Two marked photographs."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for name in "ab":
        Image.open(images[0]).convert("RGB").save(folder / f"{name}.png")
    corners = [[50, 50], [100, 50], [100, 100], [50, 100]]
    (folder / "index.json").write_text(json.dumps([{"file": f"{n}.png", "corners": corners} for n in "ab"]))
    return folder


def test_photographs_are_measured(weights, marked, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("mmgsd.measure.photographs.find_root", lambda: tmp_path)
    asked = ["measure", marked, "--weights", weights]
    table = run(capsys, *asked, "--out", tmp_path / "sheet.png", "--store", "mine")
    every, named = (line.split() for line in table.splitlines()[2:4])
    assert every[:2] == ["all", "8"] and named[:2] == ["by", "name"]
    assert Image.open(tmp_path / "sheet.png").size[0] > 300
    results = json.loads(run(capsys, *asked, "--json"))
    assert json.loads((tmp_path / "data" / "results" / "photographs_mine.json").read_text()) == results
    assert results["photographs"] == 2 and results["sources"].keys() == {"own"}


@pytest.mark.parametrize(("words", "message"), [
    ("--out MARKED/a.png", "--out must not replace a file among the photographs"), ("--store ../mine", "'../mine'"),
    ("--weights towel", "towel must be a safetensors file or one of 'cloth', "),
])  # fmt: skip
def test_what_is_wrong_with_photographs_is_said(weights, marked, capsys, words, message):
    words = words.replace("MARKED", str(marked)).split()
    assert message in fail(capsys, 2, "measure", marked, "--weights", weights, *words)


def test_the_picture_does_not_replace_an_image(weights, images, capsys):
    before = Path(images[0]).read_bytes()
    said = fail(capsys, 2, "match", *images, "--xy", "5,5", "--weights", weights, "--out", images[0])
    assert "--out must not be one of the images" in said
    assert Path(images[0]).read_bytes() == before


def test_a_page_holds_so_many_queries(weights, images, capsys, tmp_path):
    asked = [word for _ in range(101) for word in ("--xy", "5,5")]
    said = fail(capsys, 2, "match", *images, *asked, "--weights", weights, "--out", tmp_path / "m.png")
    assert "--xy must be given at most 100 times with --out, got 101" in said


def raising(error):
    def stop(*_, **__):
        raise error

    return stop


def test_ctrl_c_says_what_is_kept(weights, images, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", raising(KeyboardInterrupt()))
    out = tmp_path / "new" / "m.png"
    said = fail(capsys, 130, "match", *images, "--xy", "5,5", "--weights", weights, "--out", out)
    assert said == f"stopped: {out} is as it was before\n"
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize("what", ["picture", "network"])
def test_a_full_disk_is_named(weights, images, capsys, tmp_path, monkeypatch, what):
    out = tmp_path / "new" / ("m.png" if what == "picture" else "m.onnx")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", raising(OSError(28, "No space left on device")))
    monkeypatch.setattr("onnx.save", raising(OSError(28, "No space left on device")))
    asked = ["match", *images, "--xy", "5,5", "--out", out] if what == "picture" else ["export", "--out", out]
    assert f"No space left on device while writing {out}" in fail(capsys, 1, *asked, "--weights", weights)
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize("start", [("/usr/bin/mmgsd", "mmgsd"), ("/there/mmgsd/__main__.py", "python -m mmgsd")])
def test_help_names_the_command_as_it_was_called_and_one_form_of_out(capsys, monkeypatch, start):
    monkeypatch.setattr("sys.argv", [start[0]])
    for command in ("match", "segment", "measure", "fold", "export", "heads"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        told = capsys.readouterr().out
        assert told.startswith(f"usage: {start[1]} {command} ") and re.search(r"--out FILE\b", told)


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_the_paths_of_the_sample_images_are_printed(capsys, object):
    assert run(capsys, "samples", object).splitlines() == [str(path) for path in find_samples(object)]


def test_a_command_is_asked_for(capsys):
    assert "command" in fail(capsys, 2)


def test_a_network_is_exported(weights, capsys, tmp_path):
    path, neighbour = tmp_path / "cloth.onnx", tmp_path / "cloth.tmp"
    neighbour.write_text("a user's own")
    assert "bfloat16" in run(capsys, "export", "--out", path, "--weights", weights)
    metadata = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert (metadata["input_size"], metadata["quarter_turns"], metadata["multiple_of"]) == ("64 64", "4", "8")
    assert sorted(tmp_path.iterdir()) == [path, neighbour]
    assert neighbour.read_text() == "a user's own"


def test_nothing_is_left_of_an_export_that_differs(weights, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("mmgsd.extras.exporting._compare", lambda *_: 1.0)
    said = fail(capsys, 1, "export", "--out", tmp_path / "cloth.onnx", "--weights", weights)
    assert "descriptors differ from torch's by 1.0e+00" in said
    assert list(tmp_path.iterdir()) == []


def test_onnx_needs_its_ending(weights, capsys, tmp_path):
    assert "must end with .onnx" in fail(capsys, 2, "export", "--out", tmp_path / "cloth.pt", "--weights", weights)


def test_weights_without_heads_are_measured_from_the_command_line(weights, cloth_dataset, capsys, tmp_path):
    out = run(capsys, "heads", weights, "--data", cloth_dataset, "--out", tmp_path / "heads.json")
    assert json.loads(out) == json.loads((tmp_path / "heads.json").read_text()) and json.loads(out)["heads"] is False


def test_what_cannot_be_calibrated_is_said_from_the_command_line(weights, cloth_dataset, capsys, tmp_path):
    assert "at least 40 pairs" in fail(capsys, 2, "calibrate", weights, "--data", cloth_dataset)
    assert "nowhere" in fail(capsys, 2, "calibrate", weights, "--data", tmp_path / "nowhere")
