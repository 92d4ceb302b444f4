"""Hand-made descriptors, features of networks that know no cloth, and chance, asked as the models are."""

from __future__ import annotations

from pathlib import Path

from mmgsd.config import OBJECTS, load_preset
from mmgsd.paths import Paths
from mmgsd.studies.claims import FOUND, Claim, fails, get, say
from mmgsd.studies.matrix import list_tasks, run_tasks, write_main_table
from mmgsd.studies.parameters import check_images
from mmgsd.studies.registry import Results, Study

HAND_MADE = ("sift", "surf", "orb")  # that the paper names; SURF is not in the OpenCV that pip installs


def check(paths: Paths) -> None:
    """ValueError where the test images are not rendered."""
    check_images(paths, OBJECTS)


def run(paths: Paths) -> Path:
    """Ask what is not trained; rmse.json, which has it beside the models."""
    preset = load_preset(paths.preset)
    list(run_tasks([task for task in list_tasks(preset) if isinstance(task, tuple)], preset, paths.root))
    write_main_table(preset, paths.root)
    return paths.results / "rmse.json"


def judge_hand_made(results: Results) -> Claim:
    """The hand-made descriptors that the paper names."""
    names = {"mmgsd": "MMGSD with dense supervision", "mmgsd_plain": "MMGSD"}
    shares = {m: {n: get(results, "rmse", n, m, "pck@20px") for n in OBJECTS} for m in (*HAND_MADE, *names)}
    parts = tuple(fails(shares[m][n]) for m in HAND_MADE for n in OBJECTS)
    texts = [f"{names.get(m, m.upper())} {' / '.join(say(v, 'percent') for v in row.values())}"
             for m, row in shares.items()]  # fmt: skip
    return Claim(
        "hand-made", "SIFT, SURF and ORB fail.",
        f"They find fewer than {100 * FOUND:.0f} % of the matches within 20 px; a part each method and object.",
        f"found, cloth / rope: {', '.join(texts)}", parts,
    )  # fmt: skip


STUDY = Study("baselines", 60, run, check, "04_evaluate", claims=(judge_hand_made,))
