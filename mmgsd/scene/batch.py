"""A batch of episodes, rendered into one archive.

Its job holds ``config`` (the fields of ``RenderConfig``), ``split``, ``episodes`` as [[episode, views], …], ``sheet``
(None, or the object as `PlanarObject.to_dict` gives it), ``out``, the archive to write, and where it is known ``mark``,
the job's hash, which the archive keeps.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from mmgsd.config import RenderConfig, from_dict
from mmgsd.files import atomic_write
from mmgsd.images import encode_image, encode_mask
from mmgsd.scene.objects.planar_object import PlanarObject


def run_job(job: dict[str, Any]) -> None:
    """Render a job's episodes into its archive, which appears whole or not at all; ``labels.json`` lists all views."""
    from mmgsd.scene.episode import render_episode  # not at the head: what writes views needs no Blender

    planar = PlanarObject.from_dict(job["sheet"]) if job.get("sheet") else None
    config, out = from_dict(RenderConfig, job["config"]), Path(job["out"])
    with atomic_write(out) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as archive:
        archive.comment, labels = job.get("mark", "").encode(), []
        for episode, n_views in job["episodes"]:
            for i, view in enumerate(render_episode(config, job["split"], episode, n_views, planar)):
                written = write_view(archive, episode, i, view)
                labels.append({"episode": episode, "view": i, "split": job["split"], **written})
        _add(archive, "labels.json", json.dumps(labels).encode())


def write_view(archive: zipfile.ZipFile, episode: int, index: int, view: Any) -> dict[str, Any]:
    """Add a view's image and mask to the archive; its labels as JSON values."""
    stem = f"{episode:06d}_{index:02d}"
    _add(archive, f"{stem}.webp", encode_image(view.image))
    _add(archive, f"{stem}_mask.png", encode_mask(view.mask))
    arrays = {name: getattr(view, name).tolist() for name in ("xy", "visible", "intrinsics", "camera_pose")}
    return {**arrays, "info": view.info}


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name), data)  # a ZipInfo of its own carries no date: equal content, equal bytes
