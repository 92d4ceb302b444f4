"""What a notebook may be told: every parameter is read and checked before anything slow or destructive is done."""

from __future__ import annotations

from pathlib import Path

from mmgsd.config import find_root


def find_file(path: Path | str, name: str = "path") -> Path:
    """An existing file, by one rule wherever a path is asked for; ValueError, which names ``name``, where there is none.

    A relative path is looked for from where the notebook or the command was started, then from the repository's root;
    ``~`` is the home folder.
    """
    if not isinstance(path, str | Path) or not str(path).strip():
        raise ValueError(f"{name} must be the path of a file, got {path!r}")
    asked = Path(path).expanduser()
    places = dict.fromkeys(place / asked for place in (Path.cwd(), find_root()))  # an absolute path stays as it is
    for place in places:
        if place.is_file():
            return place
    looked = " or ".join(map(str, places))
    raise ValueError(f"{name} must be the path of a file that exists, got {str(path)!r}: there is no file {looked}")
