"""The data set on disk: what is written is read back, whatever is damaged is refused with the file's name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mmgsd.dataset import (
    DatasetError,
    check_dataset,
    hold_out,
    join_datasets,
    load_dataset,
    measure_images,
    sample_pairs,
)
from mmgsd.images import encode_image, encode_mask

IMAGE, MASK = "images/00000.webp", "masks/00000.png"


def edit_labels(folder: Path, edit: Callable[[pd.DataFrame], pd.DataFrame | None]) -> None:
    labels = pd.read_parquet(folder / "labels.parquet")
    edited = edit(labels)
    (labels if edited is None else edited).to_parquet(folder / "labels.parquet", index=False)


def set_cell(column: str, change: Callable[[np.ndarray], object]) -> Callable[[Path], None]:
    """Replaces the first row's value of a column by ``change`` of it."""

    def edit(labels: pd.DataFrame) -> None:
        labels[column] = [change(labels[column].iloc[0].copy()), *labels[column].iloc[1:]]

    return lambda folder: edit_labels(folder, edit)


def set_cell_of_text(column: str, text: str) -> Callable[[Path], None]:
    """Replaces the first row's text of a column."""
    return lambda folder: edit_labels(folder, lambda t: t.assign(**{column: [text, *t[column].iloc[1:]]}))


def set_info(**values: object) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        path = folder / "dataset.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return damage


def truncate(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-30])


def empty_mask(folder: Path) -> None:
    (folder / MASK).write_bytes(encode_mask(np.zeros((485, 485), dtype=bool)))


def drop_key(folder: Path) -> None:
    info = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps({k: v for k, v in info.items() if k != "symmetry"}))


def with_nan(xy: np.ndarray) -> np.ndarray:
    xy[7] = np.nan
    return xy


def with_far_point(xy: np.ndarray) -> np.ndarray:
    xy[:2] = 900.0
    return xy


DAMAGES = {
    "image missing": (lambda folder: (folder / IMAGE).unlink(), f"{IMAGE} is missing"),
    "image truncated": (truncate(IMAGE), f"{IMAGE} is missing, truncated"),
    "image empty": (lambda folder: (folder / IMAGE).write_bytes(b""), f"{IMAGE} is missing, truncated"),
    "image of another size": (
        lambda folder: (folder / IMAGE).write_bytes(encode_image(np.zeros((480, 640, 3), np.uint8))),
        f"{IMAGE} is 640 x 480 px, dataset.json says 485 x 485",
    ),
    "mask missing": (lambda folder: (folder / MASK).unlink(), f"{MASK} is missing"),
    "mask truncated": (truncate(MASK), f"{MASK} is missing, truncated"),
    "mask elsewhere": (empty_mask, f"{MASK}: 625 of 625 visible points lie off the mask"),
    "table missing": (lambda folder: (folder / "labels.parquet").unlink(), "labels.parquet is missing"),
    "table truncated": (truncate("labels.parquet"), "labels.parquet is missing, damaged"),
    "columns missing": (
        lambda folder: edit_labels(folder, lambda t: t.drop(columns=["visible", "view"])),
        r"labels.parquet lacks the columns \['view', 'visible'\]",
    ),
    "rows missing": (lambda folder: edit_labels(folder, lambda t: t[1:]), "labels.parquet has .*'train': 3"),
    "xy too short": (set_cell("xy", lambda xy: xy[:-2]), "labels.parquet: xy of row 0 is not of length 1250"),
    "xy absent": (set_cell("xy", lambda xy: None), "labels.parquet: xy of row 0 is not of length 1250"),
    "visible too long": (set_cell("visible", lambda v: [*v, True]), "visible of row 0 is not of length 625"),
    "pose too short": (set_cell("camera_pose", lambda v: v[:12]), "camera_pose of row 0 is not of length 16"),
    "xy not finite": (set_cell("xy", with_nan), "labels.parquet: xy holds values that are not finite"),
    "xy outside": (set_cell("xy", with_far_point), f"labels.parquet: a visible point of {MASK} lies outside"),
    "nothing visible": (set_cell("visible", lambda v: v & False), f"{MASK}: no material point is visible"),
    "image elsewhere": (set_cell_of_text("file", "../../secret.webp"), "labels.parquet: file must be like .*secret"),
    "image of an absolute path": (set_cell_of_text("file", "/etc/secret.webp"), "file must be like .*secret"),
    "mask in a deeper folder": (set_cell_of_text("mask", "masks/../images/a.png"), "mask must be like"),
    "a file twice": (set_cell_of_text("file", "images/00001.webp"), "file names a file twice"),
    "markup as a state": (set_cell_of_text("state", "<script>"), "state must be like .*<script>"),
    "a negative simulation": (lambda folder: edit_labels(folder, lambda t: t.assign(episode=-1)), "episode must hold"),
    "words for numbers": (
        lambda folder: edit_labels(folder, lambda t: t.assign(intrinsics=[["a"] * 9] * len(t))),
        "labels.parquet: intrinsics must hold numbers",
    ),
    "labels of another checksum": (set_info(labels_sha256="0" * 64), "labels.parquet is .*: its SHA-256"),
    "markup as an object": (set_info(object="<b>"), "dataset.json: object must be a name .*'<b>'"),
    "size of text": (set_info(size=["485", "485"]), r"dataset.json: size must be \[width, height\]"),
    "a huge size": (set_info(size=[10**6, 10**6]), "dataset.json: size must be"),
    "markup as a group": (set_info(symmetry={"<b>": [[0]]}), "dataset.json: symmetry must be permutations"),
    "no permutation": (set_info(symmetry={"c4": [[0, 0]]}), "dataset.json: symmetry must be permutations"),
    "a group that is not there": (set_info(default_group="c9"), "default_group must be one of symmetry's"),
    "a setting that is none": (set_info(config={"views": "many"}), "dataset.json: config must be what RenderConfig"),
    "no number of images": (set_info(images={"train": "4"}), "dataset.json: images must be the number"),
    "markup as a version": (set_info(versions={"bpy": "<b>"}), "dataset.json: versions must be"),
    "a mirror that is none": (set_info(mirror=[0, 0, 1]), "dataset.json: mirror must be null, or each"),
    "a list": (lambda folder: (folder / "dataset.json").write_text("[]"), "dataset.json must hold an object with keys"),
    "another format": (set_info(format=2), "dataset.json has format 2, this version reads 1"),
    "keys missing": (drop_key, r"dataset.json lacks the keys \['symmetry'\]"),
    "no JSON": (lambda folder: (folder / "dataset.json").write_text("{"), "dataset.json is damaged or no JSON"),
    "shared simulation": (
        lambda folder: edit_labels(folder, lambda t: t.assign(episode=0)),
        r"cloth: simulations \[0\] are in both splits",
    ),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_damage_is_refused(tiny_dataset: Callable[..., Path], damage: Callable[[Path], None], message: str) -> None:
    folder = tiny_dataset()
    damage(folder)
    with pytest.raises(DatasetError, match=message):
        check_dataset(folder)


def hide_object(folder: Path, *, mask: bool = False) -> None:
    """Say of the first of the images that it does not show the object; its mask shows it still, if so asked."""

    def edit(table: pd.DataFrame) -> pd.DataFrame:
        seen = [v & (i > 0) for i, v in enumerate(table.visible)]
        return table.assign(present=np.arange(len(table)) > 0, visible=seen)

    edit_labels(folder, edit)
    if not mask:
        empty_mask(folder)


def test_an_image_without_the_object_has_neither_points_nor_mask(tiny_dataset: Callable[..., Path]) -> None:
    folder = tiny_dataset()
    assert load_dataset(folder).present.all()
    hide_object(folder)
    assert check_dataset(folder).images.to_dict() == {"train": 4, "test": 2}
    data = load_dataset(folder)
    assert data.present.tolist() == [False, True, True, True]
    assert len(measure_images(data)) == 3


def test_an_image_that_shows_the_object_all_the_same_is_refused(tiny_dataset: Callable[..., Path]) -> None:
    folder = tiny_dataset()
    hide_object(folder, mask=True)
    with pytest.raises(DatasetError, match=f"{MASK}: the object is said not to be present, but is seen"):
        check_dataset(folder)


def test_no_pair_is_of_an_image_without_the_object(rng: np.random.Generator) -> None:
    present = np.array([True, False, True, True])
    assert 1 not in sample_pairs(np.arange(4), 6, rng, present=present)
    with pytest.raises(ValueError, match="at least 2 images to make a pair, got 1"):
        sample_pairs(np.arange(2), 1, rng, present=np.array([True, False]))


def test_an_image_need_not_have_things_to_name(tiny_dataset: Callable[..., Path]) -> None:
    folder = tiny_dataset()
    edit_labels(folder, lambda labels: labels.assign(things=["", "hand, box", *[""] * (len(labels) - 2)]))
    assert list(load_dataset(folder, "train").labels.things[:2]) == ["", "hand, box"]


def test_labels_come_back(cloth_dataset: Path) -> None:
    data, stored = load_dataset(cloth_dataset, "test"), pd.read_parquet(cloth_dataset / "labels.parquet")
    assert (data.xy.shape, data.visible.shape, len(data)) == ((4, 625, 2), (4, 625), 4)
    np.testing.assert_array_equal(data.xy[0].ravel(), stored[stored.split == "test"].xy.iloc[0])
    assert data.episode.tolist() == stored[stored.split == "test"].episode.tolist()


@pytest.mark.parametrize(("object", "size"), [("cloth", (485, 485)), ("rope", (640, 480))])
def test_a_whole_data_set_passes_and_its_images_are_lossless(
    tiny_dataset: Callable[..., Path], rng: np.random.Generator, object: str, size: tuple[int, int]
) -> None:
    folder = tiny_dataset(object=object, n_train=4, n_test=2)
    assert check_dataset(folder).images.to_dict() == {"train": 4, "test": 2}
    data = load_dataset(folder)
    assert data.size == size
    image, mask = rng.integers(0, 256, (*size[::-1], 3), dtype=np.uint8), rng.random(size[::-1]) < 0.5
    (folder / IMAGE).write_bytes(encode_image(image))
    (folder / MASK).write_bytes(encode_mask(mask))
    np.testing.assert_array_equal(data.load_image(0), image)
    np.testing.assert_array_equal(data.load_mask(0), mask)


def test_groups_are_data(cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset)
    assert (data.group().name, data.group().order, data.group("d4").order) == ("c4", 4, 8)
    with pytest.raises(ValueError, match="group must .*got 'c3'"):
        data.group("c3")


def test_fingerprint_is_that_of_the_scenes(tiny_dataset: Callable[..., Path]) -> None:
    """Data from before the scenes were counted are those of the first ones: models stay theirs."""
    folder = tiny_dataset()
    versions = {k: v for k, v in load_dataset(folder, "test").info["versions"].items() if k != "scenes"}

    def fingerprint(**scenes: int | str) -> str:
        set_info(versions={**scenes, **versions})(folder)
        return load_dataset(folder, "test").fingerprint

    assert fingerprint() == fingerprint(scenes=1)
    assert len({fingerprint(), fingerprint(scenes=2), fingerprint(scenes="1-12345678")}) == 3


def test_what_is_not_there_is_named(cloth_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="split must .*got 'validation'"):
        load_dataset(cloth_dataset, "validation")
    with pytest.raises(FileNotFoundError, match="dataset.json does not exist"):
        load_dataset(tmp_path)


EPISODES = np.repeat(np.arange(4), 3)


def test_pairs_are_of_different_simulations_and_do_not_repeat_while_images_suffice(rng: np.random.Generator) -> None:
    first, second = sample_pairs(EPISODES, 500, rng).T
    assert (EPISODES[first] != EPISODES[second]).all()
    assert len(np.unique(sample_pairs(EPISODES, 12 * 9, rng), axis=0)) == 12 * 9


def test_pairs_of_one_simulation_are_never_one_image(rng: np.random.Generator) -> None:
    first, second = sample_pairs(np.zeros(5, dtype=int), 100, rng).T
    assert (first != second).all()


def test_measured_images_are_those_of_the_pixels(cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "train")
    table = measure_images(data)
    image, mask = data.load_image(2), data.load_mask(2)
    np.testing.assert_array_equal(table.object_colour[2], np.median(image[mask], 0))
    np.testing.assert_array_equal(table.background_colour[2], np.median(image[~mask], 0))
    assert table.visible.to_list() == [1.0] * len(data)
    assert set(table.state) == {"flat"}


def test_last_simulations_are_held_out(tiny_dataset: Callable[..., Path]) -> None:
    data = load_dataset(tiny_dataset(n_train=6))
    kept, held = hold_out(data)
    assert (kept.episode.tolist(), held.episode.tolist()) == ([0, 0, 1, 1], [2, 2])
    np.testing.assert_array_equal(held.xy, data.xy[4:])
    np.testing.assert_array_equal(held.load_image(1), data.load_image(5))
    assert [len(part) for part in hold_out(kept)] == [2, 2] and [len(part) for part in hold_out(held)] == [2, 2]


def test_joined_data_sets_keep_images_and_simulations_apart(tiny_dataset: Callable[..., Path], tmp_path: Path) -> None:
    folder = tiny_dataset()
    other = shutil.copytree(folder, tmp_path / "other")
    edit_labels(other, lambda labels: labels.iloc[::-1])
    first, second = (load_dataset(place, "train") for place in (folder, other))
    joined = join_datasets(first, second)
    assert len(joined) == len(first) + len(second)
    assert len(np.unique(joined.episode)) == len(np.unique(first.episode)) + len(np.unique(second.episode))
    assert (joined.load_image(len(first)) == second.load_image(0)).all()
    assert joined.fingerprint != first.fingerprint
    assert join_datasets(first).fingerprint == first.fingerprint


def test_data_sets_of_different_objects_are_not_joined(tiny_dataset: Callable[..., Path]) -> None:
    cloth, rope = (load_dataset(tiny_dataset(object=name), "train") for name in ("cloth", "rope"))
    with pytest.raises(ValueError, match="must be alike .*cloth.*rope"):
        join_datasets(cloth, rope)
