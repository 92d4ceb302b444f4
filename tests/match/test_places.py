"""Places asked for by name, without a first picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import mmgsd
from mmgsd.__main__ import main
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.match.places import NAMES, lay_flat, shrink_sources
from mmgsd.measure.photographs import ask_by_name, read_photographs
from mmgsd.model.tensors import read_tensors, write_tensors
from mmgsd.symmetry import load_group

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "data" / "sample"
WRONG = {
    "cloth": ["corner", 625, -1, True, 0.5, (0.5, 1.2), (0.1, 0.2, 0.3), None, ["corners", "ends"]],
    "rope": ["corners", 1.5, (0.5, 1.0, 2.0), np.nan],
}


@pytest.fixture(scope="module", params=["cloth", "rope"])
def data(request: pytest.FixtureRequest) -> Dataset:
    return load_dataset(SAMPLE / request.param, "test")


@pytest.fixture(scope="module")
def matcher(data: Dataset) -> Matcher:
    return mmgsd.load(data.object)


def test_a_place_by_name_is_found_in_an_image(matcher: Matcher, data: Dataset) -> None:
    for name, point in NAMES[data.object].items():
        orbit = load_group(data.object, matcher.config.group).distinct_modes(point)
        distances = []
        for index in range(len(data)):
            match = matcher.find(data.load_image(index), name)
            assert match.modes.shape[:2] == (1, matcher.num_modes) or match.modes.shape[:2] == (1, len(orbit))
            modes = match.modes[0][np.isfinite(match.modes[0]).all(1)]
            true = data.xy[index][orbit[data.visible[index, orbit]]]
            distances += np.linalg.norm(true[:, None] - modes, axis=-1).min(1).tolist()
        assert np.median(distances) < 30, name  # px; of 485 or 640


def test_a_place_is_asked_for_as_a_pixel_is(matcher: Matcher, data: Dataset) -> None:
    image, names = data.load_image(0), list(NAMES[data.object])
    match = matcher.find(image, names)
    assert len(match) == len(names) and (match.on_object == 1).all()
    numbers = matcher.find(image, [NAMES[data.object][name] for name in names])
    np.testing.assert_array_equal(match.modes, numbers.modes)
    for answer in (*matcher.match_many([(None, image, names)]), matcher.prepare(None, image).match(names)):
        np.testing.assert_array_equal(match.modes, answer.modes)
    joint = matcher.find(image, names, joint=True)
    assert joint.modes.shape == (len(names), matcher.num_modes, 2) and joint.joint_weights.sum() == pytest.approx(1)
    assert match.plot() is not None


def test_where_a_place_lies_says_it_too(matcher: Matcher, data: Dataset) -> None:
    where = {"cloth": ("corners", (0.0, 0.0)), "rope": ("ends", 0.0)}[data.object]
    first, second = (matcher.find(data.load_image(0), place).modes for place in where)
    np.testing.assert_array_equal(first, second)


def test_several_pictures_of_a_place_are_averaged(matcher: Matcher, data: Dataset) -> None:
    point = NAMES[data.object][next(iter(NAMES[data.object]))]
    seen = [index for index in range(len(data)) if data.visible[index, point]][:3]
    place = matcher.average((data.load_image(index), data.xy[index, point]) for index in seen)
    modes = matcher.find(data.load_image(seen[0]), place).modes[0]
    assert np.linalg.norm(modes - data.xy[seen[0], point], axis=1).min() < 40
    with pytest.raises(ValueError, match="joint"):
        matcher.find(data.load_image(0), place, joint=True)
    with pytest.raises(ValueError, match="pictures"):
        matcher.average([])
    with pytest.raises(ValueError, match="xy"):
        matcher.average([(data.load_image(0), (-9, 3))])


def test_sources_move_towards_the_places_that_they_look_like() -> None:
    places = torch.tensor([[0.0, 0.0], [2.0, 0.0], [9.0, 9.0]])
    sources = torch.tensor([[[0.0, 1.0], [1.0, 1.0], [8.0, 9.0]]])  # near the first, between two, near the last
    whole = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]]])
    torch.testing.assert_close(shrink_sources(sources, places, 1.0), whole, atol=1e-3, rtol=0)
    torch.testing.assert_close(shrink_sources(sources, places, 0.5), (sources + whole) / 2, atol=1e-3, rtol=0)
    torch.testing.assert_close(shrink_sources(sources, places, 0.0), sources)
    wide = shrink_sources(sources, places, 1.0, bandwidth=1000.0)  # where one distance is as good as another
    torch.testing.assert_close(wide, places.mean(0).expand(1, 3, 2), atol=0.1, rtol=0)


def test_what_pixels_are_asked_with_shrinks_and_what_places_are_hardly_moves(data: Dataset) -> None:
    matcher = mmgsd.load(data.object)
    matcher.shrinkage = 0.5
    said, xy = matcher.describe([data.load_image(0)])[0], torch.from_numpy(data.xy[0][data.visible[0]])
    raw, shrunk = (matcher.sample_sources(said, xy, data.size, shrink=shrink)[0] for shrink in (False, True))
    nearest = [torch.cdist(sources, matcher.places).amin(1).mean() for sources in (raw, shrunk)]
    assert nearest[1] < (1 - 0.8 * matcher.shrinkage) * nearest[0]
    flat = matcher.lay_flat()
    own = matcher.sample_sources(flat.outputs, torch.from_numpy(flat.xy), flat.image.shape[1::-1])[0]
    moved = (own - matcher.places).norm(dim=1) / matcher.places.norm(dim=1)
    assert moved.mean() < 0.02 and moved.max() < 0.1


def test_a_share_is_from_0_to_1(matcher: Matcher) -> None:
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="shrinkage"):
            Matcher(matcher.network, matcher.config, modes=2, size=(64, 64), shrinkage=wrong)


def test_other_places_are_refused(matcher: Matcher, data: Dataset) -> None:
    for wrong in WRONG[data.object]:
        with pytest.raises(ValueError, match="places must be '"):
            matcher.find(data.load_image(0), wrong)
    with pytest.raises(ValueError, match="mask0"):
        matcher.match(None, data.load_image(0), 0, mask0=np.ones(data.size[::-1], bool))


def test_weights_without_places_say_how_they_get_them(data: Dataset) -> None:
    matcher = mmgsd.load(data.object)
    matcher.places = None
    with pytest.raises(ValueError, match="mmgsd calibrate"):
        matcher.find(data.load_image(0), 0)


def test_an_object_of_ones_own_has_numbers() -> None:
    flat = lay_flat(torch.rand(5, 4), "towel", "c2")
    xy, counts = flat.look_up([0, 4])
    assert xy.tolist() == [[0, 7.5], [4, 7.5]] and counts is None and flat.mask[7, 4]
    for wrong in (5, "corners", 0.5):
        with pytest.raises(ValueError, match="number below 5"):
            flat.look_up(wrong)
    with pytest.raises(ValueError, match="625"):
        lay_flat(torch.rand(5, 4), "rope", "c2")


def test_a_file_keeps_places_and_refuses_damaged_ones(matcher: Matcher, data: Dataset, tmp_path: Path) -> None:
    tensors, note = read_tensors(find_weights(data.object))
    path = write_tensors(tmp_path / "weights.safetensors", tensors | {"places": matcher.places}, note)
    torch.testing.assert_close(mmgsd.load(path).places, matcher.places)
    for bad in (matcher.places[:, :3], matcher.places * torch.nan, matcher.places[:0]):
        write_tensors(path, tensors | {"places": bad}, note)
        with pytest.raises(ValueError, match=r"weights\.safetensors is damaged"):
            mmgsd.load(path)


def test_places_are_found_from_the_command_line(
    data: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = str(data.folder / data.labels.file[0])
    names = [*NAMES[data.object], "0.25,0.5" if data.object == "cloth" else "0.25", "7"]
    asked = ["find", image, *names, "--weights", data.object]
    main([*asked, "--out", str(tmp_path / "found.png")])
    assert [line.partition(" -> ")[0] for line in capsys.readouterr().out.splitlines()] == names
    assert (tmp_path / "found.png").stat().st_size > 10_000
    main([*asked, "--json", "--joint"])
    told = json.loads(capsys.readouterr().out)
    assert [query["place"] for query in told][0] == names[0] and all(query["modes"] for query in told)


def test_what_is_found_by_name_is_counted(matcher: Matcher, data: Dataset) -> None:
    photographs = read_photographs(SAMPLE / "photographs.json", data.object)
    found = ask_by_name(matcher, photographs)
    assert len(found) == len(photographs) and all(0 <= row["found@5%"][0] <= row["found@10%"][0] <= 1 for row in found)
    matcher_without = mmgsd.load(data.object)
    matcher_without.places = None
    assert ask_by_name(matcher_without, photographs) == []
