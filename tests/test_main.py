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
from mmgsd.matching import Matcher, load
from mmgsd.training import train_model

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
        ({"xy": "9000,3"}, 1, "xy must be finite and inside image0 of 300 x 200 px"),
        ({"--n": "0"}, 2, "must be a number from 1 on, or auto, got '0'"),
        ({"--weights": "towel"}, 1, "towel must be a safetensors file or one of 'cloth', "),
        ({"--out": "match.txt"}, 2, "argument --out: must end with .png"),
        ({"image1": "nowhere.png"}, 1, "nowhere.png"),
        ({"image1": __file__}, 1, "is no image that can be read"),
    ],
)
def test_what_is_wrong_is_said(weights, images, capsys, changed, code, message):
    options = {"--weights": weights, **{k: v for k, v in changed.items() if k.startswith("--")}}
    words = [word for option in options.items() for word in option]
    arguments = [images[0], changed.get("image1", images[1]), "--xy", changed.get("xy", "5,5"), *words]
    assert message in fail(capsys, code, "match", *arguments)


def test_a_command_is_asked_for(capsys):
    assert "command" in fail(capsys, 2)


def test_onnx_gives_the_same_descriptors(weights, capsys, tmp_path):
    path = tmp_path / "cloth.onnx"
    assert "differ from torch's by" in run(capsys, "export", path, "--weights", weights)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert session.get_modelmeta().custom_metadata_map["input_size"] == "64 64"
    image, network = torch.rand(3, 3, 64, 64), load(weights, device="cpu").network
    network.reduced_precision = False
    with torch.inference_mode():
        expected = network(image).numpy()
    (got,) = session.run(None, {"image": image.numpy()})
    np.testing.assert_allclose(got, expected, atol=1e-3 * np.abs(expected).max())
    assert list(tmp_path.iterdir()) == [path]


def test_onnx_needs_its_ending(weights, capsys, tmp_path):
    assert "path must end with .onnx" in fail(capsys, 1, "export", tmp_path / "cloth.pt", "--weights", weights)
