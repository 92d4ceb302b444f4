"""The command line answers in one line, as JSON and as a picture, and says what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from PIL import Image

from mmgsd.__main__ import main
from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import Matcher, load

CONFIG = TrainConfig(steps=1, batch=2, pairs=2, queries=4, input_px=64, descriptor_dim=4)


@pytest.fixture(scope="module")
def weights(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_model(CONFIG, cloth_dataset, tmp_path_factory.mktemp("model"), device="cpu", progress=False)


@pytest.fixture
def images(cloth_dataset: Path, tmp_path: Path) -> list[str]:
    """Two files of other sizes and kinds than the training's."""
    data, paths = load_dataset(cloth_dataset), [tmp_path / "a.png", tmp_path / "b.jpg"]
    Image.fromarray(data.load_image(0)).resize((300, 200)).convert("RGBA").save(paths[0])
    Image.fromarray(data.load_image(1)).resize((120, 160)).save(paths[1])
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


@pytest.mark.parametrize(
    ("changed", "code", "message"),
    [
        ({"xy": "7"}, 2, "must be column,row such as 212,148, got '7'"),
        ({"xy": "a,b"}, 2, "must be two numbers such as 212,148, got 'a,b'"),
        ({"xy": "9000,3"}, 2, "xy must be finite and inside image0 of 300 x 200 px"),
        ({"--n": "0"}, 2, "must be a number from 1 to 64, or auto, got '0'"),
        ({"--n": "65"}, 2, "must be a number from 1 to 64, or auto, got '65'"),
        ({"--n": "²"}, 2, "must be a number from 1 to 64, or auto, got '²'"),
        ({"xy": "nan,3"}, 2, "xy must be finite"),
        ({"--weights": "."}, 2, ". is a folder"),
        ({"--weights": __file__}, 2, "is truncated or no safetensors file"),
        ({"--weights": "towel"}, 2, "towel must be a safetensors file or one of 'cloth', "),
        ({"--out": "match.txt"}, 2, "argument --out: must end with .png"),
        ({"image1": "nowhere.png"}, 2, "nowhere.png does not exist"),
        ({"image1": "."}, 2, ". is a folder"),
        ({"image1": __file__}, 2, "is no image that can be read"),
    ],
)
def test_what_is_wrong_is_said(weights, images, capsys, changed, code, message):
    options = {"--weights": weights, **{k: v for k, v in changed.items() if k.startswith("--")}}
    words = [word for option in options.items() for word in option]
    arguments = [images[0], changed.get("image1", images[1]), "--xy", changed.get("xy", "5,5"), *words]
    said = fail(capsys, code, "match", *arguments)
    assert message in said
    assert said.startswith("usage: ") or (said.startswith("error: ") and said.count("\n") == 1)


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
    asked = ["match", *images, "--xy", "5,5", "--out", out] if what == "picture" else ["export", out]
    assert f"No space left on device while writing {out}" in fail(capsys, 1, *asked, "--weights", weights)
    assert list(out.parent.iterdir()) == []


def test_a_command_is_asked_for(capsys):
    assert "command" in fail(capsys, 2)


def test_onnx_gives_the_same_descriptors_for_any_size(weights, capsys, tmp_path):
    path, neighbour = tmp_path / "cloth.onnx", tmp_path / "cloth.tmp"
    neighbour.write_text("a user's own")
    assert "differ from torch's by" in run(capsys, "export", path, "--weights", weights)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    assert (metadata["input_size"], metadata["quarter_turns"], metadata["multiple_of"]) == ("64 64", "4", "8")
    matcher = load(weights, device="cpu")
    matcher.network.reduced_precision = False
    for shape in ((3, 3, 64, 64), (1, 3, 56, 72), (1, 3, 120, 48)):
        image = torch.rand(shape)
        with torch.inference_mode():
            expected = matcher.describe_inputs(image).numpy()
        (got,) = session.run(None, {"image": image.numpy()})
        np.testing.assert_allclose(got, expected, atol=1e-3 * np.abs(expected).max())
    assert sorted(tmp_path.iterdir()) == [path, neighbour]
    assert neighbour.read_text() == "a user's own"


def test_nothing_is_left_of_an_export_that_differs(weights, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("mmgsd.extras.exporting._compare", lambda *_: 1.0)
    said = fail(capsys, 1, "export", tmp_path / "cloth.onnx", "--weights", weights)
    assert "descriptors differ from torch's by 1.0e+00" in said
    assert list(tmp_path.iterdir()) == []


def test_onnx_needs_its_ending(weights, capsys, tmp_path):
    assert "path must end with .onnx" in fail(capsys, 2, "export", tmp_path / "cloth.pt", "--weights", weights)


def test_weights_without_heads_are_measured_from_the_command_line(weights, cloth_dataset, capsys, tmp_path):
    out = run(capsys, "heads", weights, "--data", cloth_dataset, "--out", tmp_path / "heads.json")
    assert json.loads(out) == json.loads((tmp_path / "heads.json").read_text()) and json.loads(out)["heads"] is False


def test_what_cannot_be_calibrated_is_said_from_the_command_line(weights, cloth_dataset, capsys, tmp_path):
    assert "at least 40 pairs" in fail(capsys, 2, "calibrate", weights, "--data", cloth_dataset)
    assert "nowhere" in fail(capsys, 2, "calibrate", weights, "--data", tmp_path / "nowhere")
