"""The data set on disk: its format, its checker and reader, and how pairs of images are drawn from it.

Its files::

    dataset.json      object, image size, symmetry groups, mirror (optional), seed, versions, number of images of each
                      split, SHA-256 of labels.parquet (optional); `mmgsd.dataset_format` tests each
    labels.parquet    one row an image: file, mask, split, episode, view, xy, visible, intrinsics, camera_pose, state …;
                      present (optional), False where the object is not there: no visible point, an empty mask
    images/*.webp     lossless colour images          masks/*.png    1-bit object masks
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from PIL import Image

from mmgsd.checks import check, check_choice, describe_choices
from mmgsd.dataset_format import REMEDY, SPLITS, DatasetError, count_points, read_info, read_labels
from mmgsd.symmetry import SymmetryGroup


@dataclass(frozen=True)
class Dataset:
    """One split of a data set, labels in memory, images read when asked for.

    ``xy`` (N, P, 2) px, ``visible`` (N, P) bool, ``episode`` (N,) simulation of each image, ``present`` (N,) whether it
    shows the object; P is 625 of cloth or rope.
    """

    folder: Path
    split: str
    info: dict
    labels: pd.DataFrame

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def object(self) -> str:
        """Name of the object, e.g. ``cloth``."""
        return self.info["object"]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of every image in px."""
        return tuple(self.info["size"])

    @property
    def n_points(self) -> int:
        """Number of material points P."""
        return count_points(self.info)

    @cached_property
    def xy(self) -> np.ndarray:
        """(N, P, 2) float32 px, the projected material points."""
        return np.stack([np.reshape(v, (-1, 2)) for v in self.labels.xy]).astype(np.float32)

    @cached_property
    def visible(self) -> np.ndarray:
        """(N, P) bool, points that the camera sees."""
        return np.stack(self.labels.visible.to_list()).astype(bool)

    @cached_property
    def episode(self) -> np.ndarray:
        """(N,) int, the simulation that each image shows."""
        return self.labels.episode.to_numpy()

    @cached_property
    def present(self) -> np.ndarray:
        """(N,) bool, whether an image shows the object at all; True where the labels do not say."""
        return self.labels.get("present", pd.Series(True, self.labels.index)).to_numpy(bool)

    @property
    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits of what was rendered, with which versions, and how it was packed, if it was.

        Data that do not name the version of their scenes are from before these were counted: of the first.
        """
        provenance = {key: self.info[key] for key in ("config", "versions", "packed", "joined") if key in self.info}
        if "versions" in provenance:
            provenance["versions"] = {"scenes": 1, **provenance["versions"]}
        text = json.dumps(list(provenance.values()), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def group(self, name: str = "") -> SymmetryGroup:
        """The stored symmetry group of that name ("" is the object's own); ValueError names those stored."""
        name, stored = name or self.info["default_group"], self.info["symmetry"]
        check("group", name, f"{describe_choices(name, stored)} for this data set", name in stored)
        return SymmetryGroup(name, np.asarray(stored[name]))

    @property
    def mirror(self) -> np.ndarray | None:
        """Where each material point (P,) goes in a mirror image, None for an object that has no mirror image."""
        mirror = self.info.get("mirror")
        return None if mirror is None else np.asarray(mirror)

    def load_image(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8; DatasetError where the file is missing, truncated or of another size."""
        return np.asarray(_open_image(self.folder / self.labels.file.iloc[index], self.size).convert("RGB"))

    def load_mask(self, index: int) -> np.ndarray:
        """(H, W) bool, True on the object."""
        return np.asarray(_open_image(self.folder / self.labels["mask"].iloc[index], self.size).convert("1"))


def load_dataset(folder: Path | str, split: str = "train") -> Dataset:
    """Open one split after checking the table against the format and every named file's presence.

    Raises FileNotFoundError where there is no data set, ValueError for an unknown split or one that was not rendered,
    DatasetError (which names the file) for one that is damaged. ``check_dataset`` also decodes every image.
    """
    folder = Path(folder)
    check_choice("split", split, SPLITS)
    info = read_info(folder / "dataset.json")
    if split not in info["images"]:
        raise ValueError(f"{folder} has no {split} images: render them as well (without only_test)")
    labels = read_labels(folder / "labels.parquet", info)
    for name in [*labels.file, *labels["mask"]]:
        if not (folder / name).is_file():
            raise DatasetError(f"{folder / name} is missing: {REMEDY}")
    return Dataset(folder, split, info, labels[labels.split == split].reset_index(drop=True))


def check_dataset(folder: Path | str) -> pd.DataFrame:
    """Decode every image and mask and test every label; returns a table of what was checked, one row a check.

    Raises DatasetError at the first violation, with the file's name.
    """
    rows, described = [], read_info(Path(folder) / "dataset.json")["images"]
    splits = {split: load_dataset(folder, split) for split in SPLITS if split in described}
    for split, data in splits.items():
        for index in range(len(data)):
            data.load_image(index)
            _check_labels_on_mask(data, index, data.load_mask(index))
        rows.append({"split": split, "images": len(data), "visible points": round(float(data.visible.mean()), 3)})
    train, test = (set(splits[split].episode) if split in splits else set() for split in SPLITS)
    if train & test:
        raise DatasetError(f"{folder}: simulations {sorted(train & test)[:5]} are in both splits")
    return pd.DataFrame(rows).set_index("split")


def hold_out(data: Dataset) -> tuple[Dataset, Dataset]:
    """The split without its last simulations, and these: a twentieth, at least one; all in both if only one."""
    episodes = np.unique(data.episode)
    last = episodes[-max(1, round(len(episodes) * 0.05)) :]
    held_out = data.labels.episode.isin(last)
    if held_out.all():
        return data, data
    parts = (data.labels[~held_out], data.labels[held_out])
    return tuple(dataclasses.replace(data, labels=part.reset_index(drop=True)) for part in parts)


def load_parts(folder: Path | str, split: str = "train", *, also: str = "") -> list[Dataset]:
    """The data set in ``folder``, and that of the same object of the preset ``also``, where one is named.

    The latter lies beside it: ``…/workspace/cloth`` beside ``…/paper/cloth``. Errors are those of `load_dataset`.
    """
    folder = Path(folder)
    others = [folder.parents[1] / also / folder.name] if also else []
    return [load_dataset(place, split) for place in (folder, *others)]


def join_datasets(first: Dataset, *others: Dataset) -> Dataset:
    """The images of one split of several data sets as one data set, whose description is the first's.

    ValueError where they are not of one object, with images of one size and the same material points.
    """
    if not others:
        return first
    for other in others:
        theirs, ours = ((data.object, data.size, data.n_points) for data in (other, first))
        if theirs != ours:
            raise ValueError(f"data sets that are joined must be alike (object, size, material points): {first.folder} "
                             f"has {ours}, {other.folder} {theirs}")  # fmt: skip
    tables = []
    for data in (first, *others):
        places = {name: [str(data.folder.absolute() / file) for file in data.labels[name]] for name in ("file", "mask")}
        last = max((table.episode.max() for table in tables), default=-1)
        tables.append(data.labels.assign(**places, episode=data.episode + last + 1, present=data.present))
    info = first.info | {"joined": [other.fingerprint for other in others]}
    return dataclasses.replace(first, info=info, labels=pd.concat(tables, ignore_index=True))


def measure_images(data: Dataset) -> pd.DataFrame:
    """What the images of a split are like, one row an image that shows the object.

    ``state``, the ``visible`` share of the material points, and the median colours (3,) of the pixels on and off the
    object's mask, ``object_colour`` and ``background_colour``.
    """
    rows = []
    indices = np.flatnonzero(data.present)
    for index in indices:
        image, mask = data.load_image(index), data.load_mask(index)
        colours = {"object_colour": np.median(image[mask], 0), "background_colour": np.median(image[~mask], 0)}
        rows.append({"visible": data.visible[index].mean(), **colours})
    state = data.labels.state.to_numpy()[indices] if "state" in data.labels else "unknown"
    return pd.DataFrame(rows).assign(state=state)


def sample_pairs(
    episode: np.ndarray, n_pairs: int, rng: np.random.Generator, *, present: np.ndarray | None = None
) -> np.ndarray:
    """Draw ``n_pairs`` ordered pairs of different images, of different simulations where there are several.

    Only of images that are ``present`` (N,) bool, where that is given: those that show the object. Returns (n_pairs, 2)
    int; without repetition while the images suffice. ValueError where no pair exists.
    """
    able = np.ones(len(episode), dtype=bool) if present is None else np.asarray(present, dtype=bool)
    first, second = np.nonzero(~np.eye(len(episode), dtype=bool) & able & able[:, None])
    if len(np.unique(episode)) > 1:
        keep = episode[first] != episode[second]
        first, second = first[keep], second[keep]
    if len(first) == 0:
        raise ValueError(f"episode must hold at least 2 images to make a pair, got {able.sum()}")
    picked = rng.choice(len(first), n_pairs, replace=n_pairs > len(first))
    return np.stack([first[picked], second[picked]], axis=1)


def _open_image(path: Path, size: tuple[int, int]) -> Image.Image:
    try:
        image = Image.open(path, formats=("WEBP", "PNG"))
        if image.size == size:  # else nothing is decoded: a small file can hold a huge image
            image.load()
    except Exception as error:  # of a damaged file Pillow raises nearly anything
        raise DatasetError(f"{path} is missing, truncated or no image: {error}: {REMEDY}") from error
    if image.size != size:
        raise DatasetError(f"{path} is {image.size[0]} x {image.size[1]} px, dataset.json says {size[0]} x {size[1]}")
    return image


def _check_labels_on_mask(data: Dataset, index: int, mask: np.ndarray) -> None:
    """Visible points must lie on the object, but for a few at its very edge; there are none where it is not present."""
    name, (width, height) = data.labels["mask"].iloc[index], data.size
    xy, visible = data.xy[index], data.visible[index]
    if not data.present[index]:
        if visible.any() or mask.any():
            raise DatasetError(f"{data.folder / name}: the object is said not to be present, but is seen")
        return
    if not visible.any():
        raise DatasetError(f"{data.folder / name}: no material point is visible")
    column, row = np.rint(xy[visible]).astype(int).T
    if not ((column >= 0) & (column < width) & (row >= 0) & (row < height)).all():
        raise DatasetError(f"{data.folder / 'labels.parquet'}: a visible point of {name} lies outside the image")
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8))[row, column] > 0
    if near.mean() < 0.98:
        raise DatasetError(f"{data.folder / name}: {np.sum(~near)} of {near.size} visible points lie off the mask")
