"""What stands for Blender's children: batches of one flat rope, written in milliseconds."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from mmgsd.scene.batch import write_view

WIDTH, HEIGHT = 640, 480


def draw_view() -> SimpleNamespace:
    """A straight rope, in the fields of what the scene renders."""
    xy = np.column_stack([np.linspace(100, 540, 625), np.full(625, 240.0)])
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[230:251, 90:551] = True
    image = np.where(mask[..., None], 200, 30).astype(np.uint8).repeat(3, -1)
    arrays = {"visible": np.ones(625, bool), "intrinsics": np.eye(3), "camera_pose": np.eye(4)}
    return SimpleNamespace(image=image, mask=mask, xy=xy, info={"state": "straight"}, **arrays)


def run_child(job: dict, folder: Path) -> tuple[int, str]:
    """In place of `stage.run_child`: writes the archive of a job's views."""
    view, buffer, labels = draw_view(), io.BytesIO(), []
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.comment = job["mark"].encode()
        for episode, views in job["episodes"]:
            for index in range(views):
                written = write_view(archive, episode, index, view)
                labels.append({"episode": episode, "view": index, "split": job["split"], **written})
        archive.writestr("labels.json", json.dumps(labels))
    Path(job["out"]).write_bytes(buffer.getvalue())
    return 0, ""
