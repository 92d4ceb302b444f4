"""The explorer in a real browser: on a bare page whose kernel the test plays, and in JupyterLab as a reader walks."""

from __future__ import annotations

import base64
import importlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, PATIENCE_MS, ROOT, VIEWPORT, click_figure, locate, open_chromium, open_explorer, run_lab
from PIL import Image

from mmgsd.extras.explorer import Pictures, show_scene
from mmgsd.extras.explorer_scenes import Scene

pytest.importorskip("playwright")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")

HOSTILE = '<img src=x onerror="window.attacked = 1"><script>window.attacked = 1</script>'
STAND_IN = """async ([script, state]) => {
    const decode = (value) => value?.base64 !== undefined
        ? new DataView(Uint8Array.from(atob(value.base64), (c) => c.charCodeAt(0)).buffer) : value;
    const load = (values) => Object.fromEntries(Object.entries(values).map(([name, value]) => [name, decode(value)]));
    const heard = {}, traits = load(state);
    traits.pair = load(traits.pair);
    window.sent = [];
    window.kernel = {
        keep: (name, value) => { traits[name] = value; },
        tell: (message) => heard['msg:custom'](message),
        set: (name, values) => { traits[name] = load(values); heard[`change:${name}`](); },
    };
    const model = { get: (name) => traits[name], on: (name, act) => { heard[name] = act; }, off() {},
        send: (message) => { window.sent.push(message); } };
    const module = await import('data:text/javascript;base64,' + script);
    document.body.innerHTML = '<div id="here"></div>';
    module.default.render({ model, el: document.getElementById('here') });
}"""


# ---- a bare page


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with open_chromium() as page:
        yield page


def encode(values: dict) -> dict:
    return {k: {"base64": base64.b64encode(v).decode()} if isinstance(v, bytes) else v for k, v in values.items()}


def make_pair(number: int, level: int = 0, **other: Any) -> dict:
    """A pair of evenly grey pictures of 200 by 100 px, as the kernel tells of it."""
    image = np.full((100, 200, 3), level, np.uint8)
    scene = Scene(image, image, f"left {number}", f"right {number}")
    return encode({"id": number, "number": number, "count": 9, **show_scene(scene), **other})


def make_answer(pair: int, *xy: tuple[float, float]) -> dict:
    mode = {"xy": [150.0, 50.0], "weight": 1.0, "spread_px": 5.0, "confidence": 0.9}
    told = [{"xy": list(point), "modes": [mode], "entropy": 5.0, "outside": 0.1} for point in xy]
    ellipse = {"x": 150.0, "y": 50.0, "major": 6.0, "minor": 4.0, "angle": 0.0}
    points = [{"ellipses": [ellipse], "matches": []} for _ in xy]
    shown = {"json": json.dumps(told), "points": points, "heat": bytes(range(2)), "heat_size": [2, 1]}
    return encode({"pair": pair, "number": 1, "milliseconds": 3, **shown})


@pytest.fixture
def bare(chromium: Any) -> Any:
    """A page with the explorer, pair 1 of grey 0 seen, no question asked."""
    script = base64.b64encode(Pictures._esm.encode()).decode()
    style = (ROOT / "mmgsd" / "extras" / "explorer.css").read_text()
    chromium.set_content("<body></body>")
    chromium.add_style_tag(content=style)
    state = {
        "pair": make_pair(1),
        "answer": {},
        "methods": [["mmgsd", "MMGSD"], ["spcl", HOSTILE]],
        "method": "mmgsd",
        "together": False,
    }
    colours = base64.b64encode(bytes(768)).decode()
    chromium.evaluate(STAND_IN, [script, {**state, "marks": "[]", "heat_colours": {"base64": colours}}])
    chromium.get_by_text("left 1").wait_for()
    return chromium


def tell(page: Any, **message: Any) -> None:
    page.evaluate("message => window.kernel.tell(message)", message)


def show(page: Any, name: str, values: dict) -> None:
    page.evaluate("([name, values]) => window.kernel.set(name, values)", [name, values])


def read_sent(page: Any) -> list[dict]:
    return page.evaluate("() => window.sent")


def look(page: Any, side: int = 1) -> np.ndarray:
    """A picture as (H, W, 3)."""
    shot = page.locator(".mmgsd-picture canvas").nth(side).screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def test_what_is_hidden_or_absent_is_said(bare: Any) -> None:
    answer = make_answer(1, (40, 50))
    bare.wait_for_timeout(100)
    assert bare.locator("th", has_text="seen there").count() == 0
    (query,) = json.loads(answer["json"])
    query["modes"][0]["visible"] = 0.2
    show(bare, "answer", {**answer, "json": json.dumps([{**query, "said": "absent: <b>no object</b>"}])})
    assert bare.locator("td").last.inner_text() == "hidden, 20 %"
    assert bare.locator("caption .mmgsd-why").inner_text() == "absent: <b>no object</b>"
    faint = look(bare)
    show(bare, "answer", answer)
    assert bare.locator(".mmgsd-why").count() == 0
    assert (look(bare) != faint).any()


@pytest.mark.parametrize("width", [700, 1000, 1400, 1900])
def test_tables_of_points_lie_apart_and_are_as_wide_as_their_content(bare: Any, width: int) -> None:
    bare.set_viewport_size({**VIEWPORT, "width": width})
    answer = make_answer(1, (40, 50), (60, 50), (80, 50))
    queries = json.loads(answer["json"])
    for query in queries:
        query["modes"] = 4 * [query["modes"][0] | {"visible": 0.999, "xy": [1150.4, 1150.4], "spread_px": 104.0}]
    points = [point | {"ellipses": 4 * point["ellipses"]} for point in answer["points"]]
    show(bare, "answer", {**answer, "json": json.dumps(queries), "points": points})
    tables = bare.locator(".mmgsd-tables table")
    boxes = tables.evaluate_all("all => all.map(one => [...Object.values(one.getBoundingClientRect().toJSON())])")
    content = tables.evaluate_all("all => all.map(one => one.scrollWidth)")
    bare.set_viewport_size(VIEWPORT)
    for (x, y, across, *_), needed in zip(boxes, content, strict=True):
        assert across + 1 >= needed
        assert not any(ox < x + across and x < ox + oa and oy == y for ox, oy, oa, *_ in boxes if (ox, oy) != (x, y))


def test_answers_that_belong_together_are_chosen_one_at_a_time(bare: Any) -> None:
    answers = bare.get_by_label("answer", exact=True)
    assert answers.is_hidden()
    bare.get_by_role("button", name="together").click()
    assert read_sent(bare)[-1] | {"token": ""} == {"do": "together", "on": True, "token": ""}
    answer = make_answer(1, (40, 50), (60, 50))
    queries = json.loads(answer["json"])
    for query, point in zip(queries, answer["points"], strict=True):
        query["modes"] = [{**query["modes"][0], "answer": k + 1, "xy": [150.0 - 80 * k, 50.0]} for k in (0, 1)]
        point["ellipses"] = [{**point["ellipses"][0], "x": mode["xy"][0]} for mode in query["modes"]]
    bare.evaluate("() => window.kernel.keep('together', true)")
    show(bare, "answer", {**answer, "json": json.dumps(queries), "joint": [0.6, 0.4]})
    assert bare.get_by_role("button", name="together").get_attribute("aria-pressed") == "true"
    assert answers.locator("option").all_inner_texts() == ["answer 1, 60 %", "answer 2, 40 %"]
    first = look(bare)
    answers.select_option("answer 2, 40 %")
    second = look(bare)
    assert (second != first).any()
    bare.locator(".mmgsd-explorer").press("b")
    np.testing.assert_array_equal(look(bare), first)
    show(bare, "answer", make_answer(1, (40, 50)))
    assert answers.is_hidden()


def test_pinned_points_are_saved_as_marks(bare: Any) -> None:
    bare.get_by_role("button", name="save marks").click()
    assert "Pin points on the left image first" in bare.locator(".mmgsd-line").inner_text()
    marks = json.dumps([{"file": "a.jpg", "ends": [[3.0, 4.0]]}])
    bare.evaluate("marks => window.kernel.keep('marks', marks)", marks)
    with bare.expect_download() as saved:
        bare.locator(".mmgsd-explorer").press("k")
    assert saved.value.suggested_filename == "index.json"
    assert Path(saved.value.path()).read_text() == marks + "\n"


def test_text_from_files_stays_text(bare: Any) -> None:
    show(bare, "pair", make_pair(2, names=[HOSTILE, HOSTILE]))
    bare.get_by_text(HOSTILE).nth(1).wait_for()
    tell(bare, error=HOSTILE, token="x")
    assert bare.locator(".mmgsd-line").inner_text() == HOSTILE
    assert bare.locator("option").nth(1).text_content() == HOSTILE
    bare.wait_for_timeout(300)  # an image that cannot be loaded would have run it by now
    assert bare.evaluate("() => window.attacked === undefined && !document.querySelector('#here img, #here script')")


def test_names_and_pictures_of_a_pair_appear_together(bare: Any) -> None:
    for number, level in ((2, 80), (3, 160), (4, 240)):  # nothing is asked between: no answer changes
        show(bare, "pair", make_pair(number, level))
        bare.get_by_text(f"left {number}").wait_for()
        assert bare.get_by_text(f"pair {number} of 9").count() == 1
        for side in (0, 1):
            assert abs(look(bare, side)[40:60, 40:60].mean() - level) < 4
    click_figure(bare, 0.5, 0.5)
    assert read_sent(bare)[-1]["pair"] == 4


def test_a_click_asks_about_the_pixel_and_a_drag_about_its_latest_only(bare: Any) -> None:
    click_figure(bare, 0.25, 0.5)
    bare.mouse.move(*locate(bare, 0.3, 0.5))
    bare.mouse.down()
    for share in (0.4, 0.5, 0.75):
        bare.mouse.move(*locate(bare, share, 0.5))
    bare.mouse.up()
    (first,) = read_sent(bare)
    np.testing.assert_allclose(first["xy"], [49.5, 49.5], atol=0.5)
    tell(bare, token="another view's")
    assert len(read_sent(bare)) == 1
    tell(bare, token=first["token"])
    assert len(read_sent(bare)) == 2
    np.testing.assert_allclose(read_sent(bare)[1]["xy"], [149.5, 49.5], atol=0.5)


def test_an_error_is_shown_and_the_next_click_asked(bare: Any) -> None:
    click_figure(bare, 0.5, 0.5)
    tell(bare, token=read_sent(bare)[0]["token"], error="xy must be inside")
    assert bare.locator(".mmgsd-error").inner_text() == "xy must be inside"
    click_figure(bare, 0.6, 0.5)
    assert len(read_sent(bare)) == 2


def test_an_answer_is_drawn_over_its_own_pair_only(bare: Any) -> None:
    before = look(bare)
    show(bare, "answer", make_answer(7, (10, 10)))
    assert bare.locator(".mmgsd-explorer table").count() == 0 and np.array_equal(look(bare), before)
    show(bare, "answer", make_answer(1, (10, 10), (20, 20)))
    assert bare.locator(".mmgsd-explorer table").count() == 2 and not np.array_equal(look(bare), before)
    row = bare.locator("tbody tr").first.inner_text().split()
    assert row == ["1", "150.0", "50.0", "100", "%", "±", "5", "px", "90", "%"]
    colours = bare.locator("caption .mmgsd-dot").evaluate_all("dots => dots.map(dot => dot.style.background)")
    assert len(set(colours)) == 2
    show(bare, "pair", make_pair(2))
    bare.get_by_text("left 2").wait_for()
    assert bare.locator(".mmgsd-explorer table").count() == 0


def test_zooming_keeps_the_pixel_under_the_pointer(bare: Any) -> None:
    bare.mouse.move(*locate(bare, 0.25, 0.5))
    bare.keyboard.down("Control")
    bare.mouse.wheel(0, -400)
    bare.keyboard.up("Control")
    click_figure(bare, 0.25, 0.5)
    click_figure(bare, 0.35, 0.5)
    tell(bare, token=read_sent(bare)[0]["token"])
    xy = [message["xy"] for message in read_sent(bare)]
    np.testing.assert_allclose(xy[0], [49.5, 49.5], atol=0.5)
    np.testing.assert_allclose(xy[1][0] - xy[0][0], 20 / np.exp(0.8), atol=0.3)
    tell(bare, token=read_sent(bare)[1]["token"])
    bare.keyboard.press("v")  # now a drag moves
    bare.mouse.move(*locate(bare, 0.25, 0.5))
    bare.mouse.down()
    bare.mouse.move(*locate(bare, 0.35, 0.5))
    bare.mouse.up()
    bare.keyboard.press("v")
    click_figure(bare, 0.35, 0.5)
    np.testing.assert_allclose(read_sent(bare)[2]["xy"], [49.5, 49.5], atol=0.5)
    tell(bare, token=read_sent(bare)[2]["token"])
    bare.keyboard.press("0")
    click_figure(bare, 0.5, 0.5)
    np.testing.assert_allclose(read_sent(bare)[3]["xy"], [99.5, 49.5], atol=0.5)


def test_keys_do_what_the_buttons_do(bare: Any) -> None:
    bare.locator(".mmgsd-explorer").focus()
    for key in "nprc":
        bare.keyboard.press(key)
    told = [(message["do"], message.get("to")) for message in read_sent(bare)]
    assert told == [("step", "next"), ("step", "previous"), ("step", "random"), ("clear", None)]
    bare.keyboard.press("h")
    assert bare.get_by_role("button", name="heatmap").get_attribute("aria-pressed") == "false"


# ---- JupyterLab


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, chromium: Any) -> Iterator[Any]:
    with (
        run_lab(tmp_path_factory.mktemp("lab")) as address,
        open_explorer(address, chromium.context.browser.new_page(viewport=VIEWPORT)) as page,
    ):
        yield page


def wait_for_answer(page: Any, before: str) -> None:
    page.wait_for_function(
        "b => document.querySelector('.mmgsd-tables').innerText !== b", arg=before, timeout=PATIENCE_MS
    )


def ask(page: Any, x: float, y: float, *, shift: bool = False) -> None:
    """Click and wait for the table of the answer."""
    before = page.locator(".mmgsd-tables").inner_text()
    page.mouse.move(*locate(page, x, y))
    if shift:
        page.keyboard.down("Shift")
    click_figure(page, x, y)
    page.keyboard.up("Shift")
    wait_for_answer(page, before)


def step(page: Any, name: str) -> None:
    before = page.locator(".mmgsd-count").inner_text()
    page.get_by_role("button", name=name, exact=True).click()
    page.wait_for_function(
        "b => document.querySelector('.mmgsd-count').innerText !== b", arg=before, timeout=PATIENCE_MS
    )


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ, 1 where even the sizes do."""
    return 1.0 if before.shape != after.shape else float(np.mean(np.abs(before - after).max(-1) > 8))


def test_a_click_changes_the_picture(page: Any) -> None:
    start = look(page)
    ask(page, 0.4, 0.4)
    first = look(page)
    ask(page, 0.6, 0.6)
    assert changed(start, first) > 0.01 and changed(first, look(page)) > 0.01


def test_the_bench_times_clicks(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "tests" / "bench")
    took = importlib.import_module("bench_explorer").time_clicks(page, 2)
    assert len(took) == 2 and min(took) > 0


@pytest.mark.parametrize("names", [("next", "next"), ("random", "random"), ("previous", "previous")])
def test_stepping_twice_shows_two_other_pairs_and_a_click_is_about_the_last(page: Any, names: tuple[str, str]) -> None:
    for name in names:
        before = [look(page, side) for side in (0, 1)]
        step(page, name)
        assert max(changed(before[side], look(page, side)) for side in (0, 1)) > 0.1
        assert page.locator("table").count() == 0
    ask(page, 0.5, 0.5)
    assert "Point 1" in page.locator(".mmgsd-tables").inner_text()


def test_pinned_points_are_told_apart_and_cleared(page: Any) -> None:
    step(page, "next")
    ask(page, 0.4, 0.4, shift=True)
    ask(page, 0.5, 0.6, shift=True)
    ask(page, 0.6, 0.5)
    assert page.locator(".mmgsd-explorer table").count() == 3
    page.keyboard.press("c")
    page.wait_for_function("() => !document.querySelector('.mmgsd-explorer table')", timeout=PATIENCE_MS)


def test_another_method_answers_anew(page: Any) -> None:
    ask(page, 0.45, 0.45)
    before = page.locator(".mmgsd-tables").inner_text()
    assert page.get_by_label("method").locator("option").all_inner_texts()[:3] == ["MMGSD, shipped", "MMGSD", "SPCL"]
    page.get_by_label("method").select_option(label="SPCL")
    wait_for_answer(page, before)
    assert "SPCL answered" in page.locator(".mmgsd-line").inner_text()


def test_own_files_are_opened_on_the_page(page: Any, tmp_path: Path, rng: np.random.Generator) -> None:
    files = [tmp_path / f"{HOSTILE[:10].replace('/', '')}{k}.png" for k in (0, 1)]
    for file in files:  # 14 MB, more than fits into a message
        Image.fromarray(rng.integers(0, 255, (2000, 2400, 3), dtype=np.uint8)).save(file)
    page.locator("input[type=file]").first.set_input_files(files)
    for file in files:
        page.get_by_text(file.name, exact=True).wait_for(timeout=PATIENCE_MS)
    ask(page, 0.5, 0.5)
    assert page.get_by_role("button", name="true matches").is_disabled()
    (tmp_path / "IMG.heic").write_bytes(b"\0\0\0\x18ftypheic")
    page.locator("input[type=file]").nth(1).set_input_files(tmp_path / "IMG.heic")
    page.get_by_text("IMG.heic is a HEIC image").wait_for(timeout=PATIENCE_MS)
    ask(page, 0.6, 0.6)  # and goes on


def test_the_picture_and_its_answer_are_saved(page: Any) -> None:
    ask(page, 0.55, 0.45)
    with page.expect_download() as png:
        page.get_by_role("button", name="save picture").click()
    image = Image.open(png.value.path())
    assert image.format == "PNG" and image.width > image.height
    with page.expect_download() as told:
        page.get_by_role("button", name="save JSON").click()
    (query,) = json.loads(Path(told.value.path()).read_text())
    assert {"xy", "modes", "entropy", "outside"} <= set(query)  # and more of weights that know it
    assert {"xy", "weight", "spread_px", "confidence"} <= set(query["modes"][0])
