"""How fast data sets are rendered, and where the time goes: ``python tests/bench/bench_rendering.py [images] [views]``.

First four episodes of each object in one process, with a clock on each step. Then ``images`` (default 300) of each
object at the paper's size, with as many workers as there are cores, exactly as `render_dataset` does it: processes
started, physics, labels and writing included. An episode has ``views`` (default 10).
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mmgsd.command import run_command
from mmgsd.config import OBJECTS, RenderConfig
from mmgsd.scene.stage import render_dataset

EPISODES = 4  # in one process
SEED = 1234  # not a preset's: nobody trains on these
SPLIT = """
import io, os, sys, time, zipfile
os.environ.setdefault("MMGSD_THREADS", "1")
from mmgsd.config import RenderConfig
from mmgsd.scene.__main__ import silenced, use_one_core
from mmgsd.scene.batch import write_view
clock = {}
def timed(module, name, label):
    function = getattr(module, name)
    def wrapper(*args, **kwargs):
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            clock[label] = clock.get(label, 0.0) + time.perf_counter() - start
    setattr(module, name, wrapper)
begin = time.perf_counter()
with silenced():
    use_one_core()
    from mmgsd.scene import blender, episode, randomize
    clock["start of Blender (once a process)"] = time.perf_counter() - begin
    timed(episode, "build_object", "shape (physics or geometry)")
    timed(blender, "build_bvh", "labels: tree")
    timed(blender, "find_visible", "labels: ray casts")
    timed(blender, "render_image", "Cycles and denoiser")
    timed(randomize, "draw_object_material", "materials")
    timed(randomize, "draw_background", "materials")
    views, config = [], RenderConfig(object=sys.argv[1], seed=int(sys.argv[2]))
    for number in range(int(sys.argv[3])):
        views += episode.render_episode(config, "train", number, int(sys.argv[4]))
    start = time.perf_counter()
    with zipfile.ZipFile(io.BytesIO(), "w") as archive:
        for i, view in enumerate(views):
            write_view(archive, 0, i, view)
    clock["encoding"] = time.perf_counter() - start
for label, seconds in clock.items():
    print(f"  {label:36s}{seconds / len(views):8.4f} s an image")
print(f"  {'all':36s}{(time.perf_counter() - begin) / len(views):8.4f} s an image, 1 process")
"""


def measure_throughput(kind: str, images: int, views: int) -> float:
    """Images a second of the whole stage."""
    tested = max(1, images // 8)
    sizes = {"train_images": images - tested, "test_images": tested, "views": views}
    config = RenderConfig(object=kind, seed=SEED, **sizes)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        render_dataset(config, Path(folder) / kind, progress=False)
        return images / (time.perf_counter() - start)


def main() -> None:
    """Print the split, then the line that is compared."""
    images, views = (int(given) for given in (*sys.argv[1:3], *(300, 10)[len(sys.argv) - 1 :]))
    for kind in OBJECTS:
        print(f"{kind}, {EPISODES * views} images:", flush=True)
        subprocess.run([sys.executable, "-c", SPLIT, kind, *map(str, (SEED, EPISODES, views))], check=True)
    rates = [f"{kind} {measure_throughput(kind, images, views):.2f} images/s" for kind in OBJECTS]
    print(", ".join(rates))


if __name__ == "__main__":
    run_command(main)
