"""The page without installation: its folder, its scripts beside the library, and a visit in a real browser."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser import CHROMIUM, PATIENCE_MS, open_chromium, serve_folder, visit_page
from PIL import Image

import mmgsd
from mmgsd.extras import page as page_module
from mmgsd.extras.page import LICENCES, PACKAGE, RUNTIME, describe_mixture, make_page
from mmgsd.files import ForeignFileError
from mmgsd.match.em import ModeReadout
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import fit_modes
from mmgsd.paths import find_samples

in_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")
ASK = """async ([heats, shape, n, how]) => {
    const { fitModes } = await import('./mixture.js');
    return heats.map((heat) => fitModes(heat, shape, n, how));
}"""
PHONE = {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return mmgsd.load("cloth", device="cpu")


@pytest.fixture(scope="module", autouse=True)
def exported_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """All pages here are of the same weights, and one network's file: writing it takes longest."""
    written, actual = tmp_path_factory.mktemp("network"), page_module.export_onnx

    def export(matcher: Matcher, path: Path, *, half: bool = False) -> None:
        file = written / f"{half}.onnx"
        if not file.is_file():
            actual(matcher, file, half=half)
        shutil.copy(file, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_module, "export_onnx", export)
        yield


@pytest.fixture(scope="module")
def hollow(matcher: Matcher, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page whose runtime is a stand-in."""
    folder = tmp_path_factory.mktemp("hollow")
    (folder / "package" / "dist").mkdir(parents=True)
    for name in RUNTIME:
        (folder / "package" / "dist" / name).write_text("")
    (folder / "package" / "package.json").write_text(json.dumps({"name": PACKAGE, "version": "0", "license": "MIT"}))
    return make_page(matcher, folder / "page", name="cloth", runtime=folder / "package")


@pytest.fixture(scope="module")
def whole(matcher: Matcher, tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        return make_page(matcher, tmp_path_factory.mktemp("whole") / "page", name="cloth")
    except (FileNotFoundError, RuntimeError) as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with open_chromium() as page:
        yield page


# ---- the folder


def test_the_folder_has_what_it_names_and_the_runtimes_licence(hollow: Path) -> None:
    model = json.loads((hollow / "model.json").read_text())
    assert model["samples"][:2] == [f"samples/{path.name}" for path in find_samples("cloth")]
    assert all((hollow / name).is_file() for name in model["samples"])
    assert "Microsoft" in (hollow / "ort" / "LICENSE").read_text()
    assert {path.name for path in (hollow / "ort").iterdir()} == {*RUNTIME, *LICENCES, "package.json"}
    assert (hollow / "model.onnx").stat().st_size < 10e6  # half of what `export` writes


def test_a_page_takes_the_place_of_another_and_of_nothing_else(hollow: Path, matcher: Matcher, tmp_path: Path) -> None:
    other = tmp_path / "photographs"
    other.mkdir()
    (other / "towel.jpg").write_bytes(b"mine")
    with pytest.raises(ForeignFileError, match="towel.jpg"):
        make_page(matcher, other, name="cloth", runtime=hollow.parent / "package")
    assert [path.name for path in tmp_path.rglob("*")] == ["photographs", "towel.jpg"]
    before = {path: path.read_bytes() for path in sorted(hollow.rglob("*")) if path.is_file()}
    make_page(matcher, hollow, name="cloth", runtime=hollow.parent / "package")
    assert {path: path.read_bytes() for path in sorted(hollow.rglob("*")) if path.is_file()} == before


def test_another_runtime_and_none_are_refused(
    matcher: Matcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "package" / "dist").mkdir(parents=True)
    with pytest.raises(ValueError, match="runtime.*ort.wasm.min.mjs"):
        make_page(matcher, tmp_path / "page", name="cloth", runtime=tmp_path / "package")
    monkeypatch.setattr(page_module.shutil, "which", lambda name: None)
    with pytest.raises(FileNotFoundError, match="npm"):
        make_page(matcher, tmp_path / "page", name="cloth")
    (tmp_path / "other.tgz").write_bytes(b"another archive")
    with pytest.raises(RuntimeError, match="another archive"):
        page_module._unpack(tmp_path / "other.tgz", tmp_path)
    assert not (tmp_path / "page").exists()


# ---- the scripts


@in_browser
@pytest.mark.parametrize("readout", [ModeReadout(), ModeReadout(0.05, 1.0, 6.0), ModeReadout(0.3, 2.0, 4.0)], ids=str)
def test_the_mixture_is_the_librarys_on_200_questions(
    hollow: Path, matcher: Matcher, chromium: Any, rng: np.random.Generator, readout: ModeReadout
) -> None:
    pair = matcher.prepare(*map(mmgsd.read_image, find_samples("cloth")))
    heats = torch.from_numpy(pair.match(rng.uniform(60, 420, (200, 2))).cells)
    rows, columns = heats.shape[1:]
    xs, ys = (torch.arange(count, dtype=torch.float32) for count in (columns, rows))
    expected = fit_modes(heats, 4, xs, ys, readout=readout, merge=True)
    asked = [heats.flatten(1).double().tolist(), [rows, columns], 4, describe_mixture(readout)]
    with serve_folder(hollow) as address:
        chromium.goto(f"{address}/model.json")
        found = chromium.evaluate(ASK, asked)
    px_a_cell = 485 / columns
    for k, fit in enumerate(found):
        state = np.array(fit["state"])
        there = expected.weights[k].numpy() > 0
        assert len(state) == there.sum()
        order = np.lexsort(state[:, 1::-1].T), np.lexsort(expected.modes[k, there].numpy()[:, ::-1].T)
        centre = [(columns - 1) / 2, (rows - 1) / 2]
        apart = (state[order[0], :2] + centre - expected.modes[k, there].numpy()[order[1]]) * px_a_cell
        assert np.abs(apart).max() < 0.5  # px
        np.testing.assert_allclose(state[order[0], 2], expected.weights[k, there].numpy()[order[1]], atol=0.01)
        assert fit["outside"] == pytest.approx(float(expected.outlier_mass[k]), abs=0.02)


@in_browser
@pytest.mark.parametrize("size", [(256, 256), (97, 256), (300, 310)], ids=str)
def test_pictures_are_resized_as_the_library_does(
    hollow: Path, chromium: Any, rng: np.random.Generator, size: tuple[int, int]
) -> None:
    image = rng.integers(0, 256, (201, 300, 4), dtype=np.uint8)
    with serve_folder(hollow) as address:
        chromium.goto(f"{address}/model.json")
        code = """async ([pixels, from, to]) => {
            const { resize } = await import('./answer.js');
            return Array.from(resize(Uint8Array.from(pixels), from, to));
        }"""
        found = np.reshape(chromium.evaluate(code, [image.ravel().tolist(), [300, 201], list(size)]), (3, *size[::-1]))
    expected = cv2.resize(image[..., :3], size, interpolation=cv2.INTER_AREA)
    assert np.abs(255 * found.transpose(1, 2, 0) - expected).max() < 1.01  # rounded another way


# ---- a visit


def tap(page: Any, x: float, y: float, size: tuple[int, int] = (485, 485)) -> np.ndarray:
    """The table of the answer about a pixel, (n, columns)."""
    box = page.locator("canvas").first.bounding_box()
    scale = min(box["width"] / size[0], box["height"] / size[1])
    left, top = (box[name] + (box[side] - scale * count) / 2
                 for name, side, count in (("x", "width", size[0]), ("y", "height", size[1])))  # fmt: skip
    page.mouse.click(left + (x + 0.5) * scale, top + (y + 0.5) * scale)
    page.get_by_text("Answered in").wait_for(timeout=PATIENCE_MS)
    page.get_by_text(f"Pixel ({x:.0f}, {y:.0f})").wait_for(timeout=PATIENCE_MS)
    rows = page.locator("tbody tr").all_inner_texts()
    return np.array([[float(cell.rstrip(" %")) for cell in row.split("\t")[1:4]] for row in rows])


def compare(found: np.ndarray, match: mmgsd.Match) -> float:
    """The largest distance in px of an answer's modes from the library's."""
    modes = match.modes[0][match.weights[0] > 0]
    assert len(found) == len(modes)
    return np.linalg.norm(found[:, None, :2] - modes, axis=-1).min(0).max()


@in_browser
def test_a_tap_has_the_librarys_answer_online_and_offline(
    whole: Path, matcher: Matcher, chromium: Any, tmp_path: Path
) -> None:
    matcher.network.reduced_precision = False
    try:
        images = [mmgsd.read_image(path) for path in find_samples("cloth")]
        pair = matcher.prepare(*images)
        small = images[1][:300, :410]
        other = matcher.prepare(small, images[0])
    finally:
        matcher.network.reduced_precision = True
    page = chromium.context.browser.new_page(viewport=PHONE)
    with serve_folder(whole) as address:
        visit_page(page, address)
        assert page.evaluate("() => crossOriginIsolated")
        before = page.locator("canvas").nth(1).screenshot()
        for xy in ((235, 80), (150, 350), (300, 200)):
            found = tap(page, *xy)
            assert compare(found, pair.match(np.array([xy]))) < 1  # px; the page's network has half precision
        box = page.locator("table").bounding_box()
        assert box["x"] + box["width"] <= PHONE["width"]  # nothing is cut off
        after = page.locator("canvas").nth(1).screenshot()
        assert np.mean(np.asarray(Image.open(io.BytesIO(before))) != np.asarray(Image.open(io.BytesIO(after)))) > 0.01
    page.reload(timeout=PATIENCE_MS)  # nobody serves any more
    page.get_by_text("Tap in the left picture").wait_for(timeout=PATIENCE_MS)
    files = [tmp_path / f"{name}.png" for name in ("<b>one</b>".replace("/", ""), "two")]
    for file, image in zip(files, (small, images[0]), strict=True):
        Image.fromarray(image).save(file)
    page.locator("input[type=file]").first.set_input_files(files)
    for file in files:
        page.get_by_text(file.name, exact=True).wait_for(timeout=PATIENCE_MS)
    xy = (200, 150)
    assert compare(tap(page, *xy, size=(410, 300)), other.match(np.array([xy]))) < 1
    page.close()


@in_browser
def test_a_runtime_that_computes_something_else_is_not_believed(whole: Path, chromium: Any, tmp_path: Path) -> None:
    for path in whole.iterdir():
        (tmp_path / path.name).symlink_to(path)
    model = json.loads((whole / "model.json").read_text())
    model["check"]["values"][7] += 2 * model["check"]["tolerance"]
    (tmp_path / "model.json").unlink()
    (tmp_path / "model.json").write_text(json.dumps(model))
    page = chromium.context.browser.new_page()
    with serve_folder(tmp_path) as address:
        page.goto(address, timeout=PATIENCE_MS)
        page.get_by_text("it computes other descriptors").wait_for(timeout=PATIENCE_MS)
    page.close()


@in_browser
def test_what_is_no_picture_is_refused_and_a_pasted_one_is_opened(whole: Path, chromium: Any, tmp_path: Path) -> None:
    page = chromium.context.browser.new_page()
    (tmp_path / "photo.heic").write_bytes(b"\0\0\0\x18ftypheic")
    with serve_folder(whole) as address:
        visit_page(page, address)
        page.locator("input[type=file]").first.set_input_files(tmp_path / "photo.heic")
        page.get_by_text("photo.heic cannot be read").wait_for(timeout=PATIENCE_MS)
        page.evaluate("""async () => {
            const canvas = Object.assign(document.createElement('canvas'), { width: 90, height: 60 });
            canvas.getContext('2d').fillRect(0, 0, 90, 60);
            const blob = await new Promise((resolve) => canvas.toBlob(resolve));
            const data = new DataTransfer();
            data.items.add(new File([blob], 'pasted.png', { type: 'image/png' }));
            document.dispatchEvent(new ClipboardEvent('paste', { clipboardData: data }));
        }""")
        page.get_by_text("pasted.png").wait_for(timeout=PATIENCE_MS)
    page.close()
