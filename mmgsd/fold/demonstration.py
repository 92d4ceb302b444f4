"""A demonstration: an image, and from which pixels to which the grippers went; a look each, as JSON beside its images.

    {"object": "cloth",
     "looks": [{"image": "edge_0.webp", "moves": [[[x, y], [x, y]], …], "anchors": [[x, y], …], "places": […]}, …]}

``moves``: pick and place, px of the look's image, all made at once. A pick must be on the object; a place may be
anywhere, and is carried to another picture by the motion that takes the object there. ``anchors``: further pixels on
the object that tell that motion, such as its corners, at least two of the first look. ``places``, where they are
known: which of the object's each pick and then each anchor is, as `Matcher.find` takes places.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.checks import check
from mmgsd.files import DamagedFileError, read_json, write_bytes, write_json
from mmgsd.images import check_pixels, encode_image, find_beside, read_image

LOOK = {"image", "moves", "anchors", "places"}
LEAST = 2  # pixels that tell a motion


@dataclass(frozen=True, eq=False)
class Look:
    """What was seen, and what was done then."""

    image: np.ndarray  # (H, W, 3) uint8
    moves: np.ndarray  # (M, 2, 2) px: pick and place
    anchors: np.ndarray  # (A, 2) px
    places: tuple[Any, ...] = ()  # M + A, which of the object's the picks and the anchors are; or none

    @property
    def asked(self) -> np.ndarray:
        """Pixels (M + A, 2) that are to be found again: the picks, then the anchors."""
        return np.concatenate([self.moves[:, 0], self.anchors])


@dataclass(frozen=True, eq=False)
class Demonstration:
    """An object's looks in order."""

    object: str
    looks: tuple[Look, ...]


def read_demonstration(path: Path | str) -> Demonstration:
    """Read a demonstration's JSON file and its images.

    FileNotFoundError where there is none; DamagedFileError, which names the file and what is wrong with it.
    """
    path = Path(path)
    values = read_json(path)
    if not isinstance(values, dict) or set(values) != {"object", "looks"}:
        raise DamagedFileError(f"{path} must hold an object with 'object' and 'looks', got {values!r:.80}")
    looks = values["looks"]
    if not isinstance(values["object"], str) or not isinstance(looks, list) or not looks:
        raise DamagedFileError(f"{path}: object must be a name and looks a list of at least one")
    read = tuple(_read_look(path, number, look) for number, look in enumerate(looks))
    if len(read[0].asked) < LEAST:
        raise DamagedFileError(f"{path}, look 0: at least {LEAST} picks and anchors must tell where the object lies")
    return Demonstration(values["object"], read)


def _read_look(path: Path, number: int, look: Any) -> Look:
    where = f"{path}, look {number}"
    if not isinstance(look, dict) or not {"image", "moves"} <= set(look) <= LOOK or not isinstance(look["image"], str):
        accepted = "'image', a file's name, 'moves' and maybe 'anchors' and 'places'"
        raise DamagedFileError(f"{where} must hold {accepted}, got {look!r:.80}")
    image = read_image(find_beside(path, look["image"]))
    moves, anchors = (_read_pixels(where, key, look.get(key, []), shape) for key, shape in
                      (("moves", (2, 2)), ("anchors", (2,))))  # fmt: skip
    if not len(moves):
        raise DamagedFileError(f"{where}: moves must be at least one [[x, y], [x, y]]")
    try:
        check_pixels(np.concatenate([moves.reshape(-1, 2), anchors]), image.shape[1::-1], image=look["image"])
    except ValueError as error:
        raise DamagedFileError(f"{where}: {error}") from error
    places, count = look.get("places", []), len(moves) + len(anchors)
    if not isinstance(places, list) or len(places) not in (0, count):
        accepted = f"a list of {count}, of each pick and anchor"
        raise DamagedFileError(f"{where}: places must be {accepted}, got {places!r:.80}")
    return Look(image, moves, anchors, tuple(tuple(p) if isinstance(p, list) else p for p in places))


def _read_pixels(where: str, key: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        pixels = np.array(values, float).reshape(-1, *shape) if values == [] else np.array(values, float)
    except (TypeError, ValueError):
        pixels = np.zeros(())
    if pixels.shape[1:] != shape or not np.isfinite(pixels).all():
        accepted = "a list of [[x, y], [x, y]] px" if shape == (2, 2) else "a list of [x, y] px"
        raise DamagedFileError(f"{where}: {key} must be {accepted}, got {values!r:.80}")
    return pixels


def write_demonstration(demonstration: Demonstration, path: Path, *, quality: int | None = None) -> Path:
    """Write a demonstration to ``path`` (.json), its images beside it; returns the path.

    ``quality`` of the images is as `mmgsd.images.encode_image` has it; none: lossless.
    """
    path = Path(path)
    check("path", path, "a file whose name ends with .json", path.suffix == ".json")
    looks = []
    for number, look in enumerate(demonstration.looks):
        image = path.with_name(f"{path.stem}_{number}.webp")
        write_bytes(image, encode_image(look.image, quality=quality))
        pixels = {name: getattr(look, name).round(2).tolist() for name in ("moves", "anchors")}
        looks.append({"image": image.name, **pixels, **({"places": list(look.places)} if look.places else {})})
    return write_json(path, {"object": demonstration.object, "looks": looks}, indent=None)
