"""A folder of static files that matches pictures in a browser, by ONNX Runtime Web; docs/page.md says how to host it.

The scripts lie beside this file: ``page/mixture.js`` is `mmgsd.match.mixture` and `em`, ``page/answer.js`` the
`Matcher`, and ``page/page.js`` what is seen, with the explorer's pictures and marks. The runtime is taken from its npm
package.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnxruntime

from mmgsd.config import OBJECTS
from mmgsd.extras.exporting import describe_shrinkage, export_onnx
from mmgsd.figures.style import HEAT
from mmgsd.files import check_ours, read_json, replace_folder, scratch_folder, write_json, write_text
from mmgsd.match import em, mixture
from mmgsd.match.match import LIKELY, RADIUS_PX
from mmgsd.match.matcher import Matcher
from mmgsd.model import heads
from mmgsd.model.calibration import LEVELS
from mmgsd.model.network import compute_input_size
from mmgsd.paths import find_samples

HERE = Path(__file__).parent
SCRIPTS = ("explorer_marks.js", "explorer_picture.js", "page/page.js")  # one module, in this order
STYLES = ("explorer.css", "page/page.css")
AS_THEY_ARE = ("index.html", "answer.js", "mixture.js")
PACKAGE, VERSION = "onnxruntime-web", "1.30.0"
INTEGRITY = "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ=="
RUNTIME = (  # of its package: for WebAssembly, and for WebGPU
    "ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm",
    "ort.webgpu.min.mjs", "ort-wasm-simd-threaded.asyncify.mjs", "ort-wasm-simd-threaded.asyncify.wasm",
)  # fmt: skip
CHECK_FACTOR, CHECK_MODULUS, CHECK_STEP = 7919, 1009, 97  # of the picture's values, and of the descriptors compared
CHECK_TOLERANCE = 0.02  # of the largest descriptor's value; a GPU may compute in another order
LICENCES = ("LICENSE", "ThirdPartyNotices.txt")  # which the npm package lacks and the same runtime for Python has
OURS = {*AS_THEY_ARE, "page.js", "page.css", "worker.js", "model.json", "model.onnx", "ort", "samples"}


def make_page(matcher: Matcher, out: Path | str, *, name: str, runtime: Path | str | None = None) -> Path:
    """Write the page of a network, called ``name`` on it, as the folder ``out``, whole or not at all; returns its path.

    The network is stored in half precision where that changes an output by less than a hundredth of its largest value,
    else in single. ``runtime`` is a folder of the npm package onnxruntime-web, unpacked or installed; None: npm, which
    must be there, downloads the version that the page was tried with, 32 MB. ValueError for another folder,
    FileNotFoundError without npm, RuntimeError where npm cannot get it, ForeignFileError where ``out`` holds files that
    are not a page's.
    """
    out = Path(out)
    if out.exists():
        check_ours(out, _is_ours)
    out.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(out.parent, out.name) as folder, _open_runtime(runtime) as package:
        _copy_runtime(package, folder / "ort")
        try:
            export_onnx(matcher, folder / "model.onnx", half=True)
        except RuntimeError:
            export_onnx(matcher, folder / "model.onnx")
        model = describe_model(matcher, name) | {"check": _make_check(folder / "model.onnx", matcher.least_px)}
        write_json(folder / "model.json", model | {"samples": _copy_samples(matcher, folder)}, indent=None)
        for file in AS_THEY_ARE:
            shutil.copy(HERE / "page" / file, folder / file)
        write_text(folder / "page.js", _join(SCRIPTS))
        write_text(folder / "page.css", _join(STYLES))
        version = json.dumps(_compute_digest(folder))
        write_text(folder / "worker.js", f"const VERSION = {version};\n\n{_join(['page/worker.js'])}")
        replace_folder(folder, out, _is_ours)
    return out


def describe_model(matcher: Matcher, name: str) -> dict[str, Any]:
    """What the page's scripts know of a model beside its network, as plain values."""
    config, calibration, readout = matcher.config, matcher.calibration, matcher.readout
    model = {"name": name, "size": matcher.size, "input_size": compute_input_size(matcher.size, config.input_px),
             "input_px": config.input_px, "least_px": matcher.least_px, "dim": config.descriptor_dim,
             "modes": matcher.num_modes, "temperature": matcher.temperature, "bandwidth": matcher.bandwidth,
             "elsewhere_weight": heads.ELSEWHERE_WEIGHT, "looked_up": heads.LOOKED_UP, "beside": heads.BESIDE,
             "radius_px": RADIUS_PX, "likely": LIKELY, "mixture": describe_mixture(readout), "calibration": None,
             "heat_colours": np.rint(255 * HEAT).astype(int).tolist()}  # fmt: skip
    if getattr(matcher.network, "heads", None):
        judge = matcher.network.heads.judge_layers
        model["judge"] = [[layer.weight.tolist(), layer.bias.tolist()] for layer in (judge[0], judge[2])]
    if places := describe_shrinkage(matcher):
        model["places"] = places
    if calibration is not None:
        table = [distance for distance in calibration.radius if math.isfinite(distance)]
        model["calibration"] = {"levels": LEVELS[: len(table)], "table": table, "powers": calibration.powers}
    return model


def _make_check(network: Path, least: int) -> dict[str, Any]:
    """Some descriptors of a made-up picture, by which a browser finds out whether its GPU computes what it should."""
    numbers = np.arange(3 * least**2) * CHECK_FACTOR % CHECK_MODULUS / CHECK_MODULUS
    session = onnxruntime.InferenceSession(network, providers=["CPUExecutionProvider"])
    (descriptors, *_) = session.run(None, {"image": numbers.astype(np.float32).reshape(1, 3, least, least)})
    values = descriptors.ravel()[::CHECK_STEP]
    return {"factor": CHECK_FACTOR, "modulus": CHECK_MODULUS, "step": CHECK_STEP, "values": values.tolist(),
            "tolerance": CHECK_TOLERANCE * float(np.abs(descriptors).max())}  # fmt: skip


def describe_mixture(readout: em.ModeReadout) -> dict[str, Any]:
    """How ``page/mixture.js`` fits, so that it is `mmgsd.match.mixture.fit_modes`."""
    names = dict.fromkeys(("annealing", "annealing_cycles", "collapsed", "ellipse", "even"), mixture)
    names |= dict.fromkeys(("cycles", "leap", "min_variance", "prior_weight", "spread"), em)
    settings = {name: getattr(module, name.upper()) for name, module in names.items()}
    settings |= {"tolerance": em.TOLERANCE_CELLS, "kernel": mixture.KERNEL_CELLS}
    return settings | {"roundness": readout.shape_prior, "power": readout.exponent, "sharpness": readout.mean_exponent}


def _copy_samples(matcher: Matcher, folder: Path) -> list[str]:
    """The test images beside the two samples of the object, those two first; none of an object without."""
    if matcher.object not in OBJECTS:
        return []
    two = find_samples(matcher.object)
    files = [*two, *sorted({*two[0].parent.glob("test_*.webp")} - {*two})]
    (folder / "samples").mkdir()
    for file in files:
        shutil.copy(file, folder / "samples" / file.name)
    return [f"samples/{file.name}" for file in files]


def _copy_runtime(package: Path, folder: Path) -> None:
    """ValueError for a package that lacks what the page loads."""
    sources = [package / "dist" / name for name in RUNTIME]
    missing = [source.name for source in sources if not source.is_file()]
    described = read_json(package / "package.json") if (package / "package.json").is_file() else {}
    if missing or described.get("name") != PACKAGE:
        lacks = f"lacks dist/{missing[0]}" if missing else "has no package.json of it"
        raise ValueError(f"runtime must be a folder of the npm package {PACKAGE} {VERSION}, but {package} {lacks}")
    folder.mkdir()
    for source in [*sources, *(Path(onnxruntime.__file__).with_name(name) for name in LICENCES)]:
        shutil.copyfile(source, folder / source.name)
    write_json(folder / "package.json", {key: described.get(key) for key in ("name", "version", "license")})


@contextmanager
def _open_runtime(runtime: Path | str | None) -> Iterator[Path]:
    """The folder of the runtime's package: the one given, or one that npm downloads."""
    if runtime is not None:
        yield Path(runtime)
        return
    npm = shutil.which("npm")
    if npm is None:
        raise FileNotFoundError(f"npm is not installed: install it, or give the folder of {PACKAGE} {VERSION} as "
                                f"runtime, unpacked from the archive that `npm pack {PACKAGE}@{VERSION}` writes on "
                                "another machine")  # fmt: skip
    with TemporaryDirectory() as folder:
        command = [npm, "pack", f"{PACKAGE}@{VERSION}", "--silent", "--fetch-retries", "1",
               "--pack-destination", folder]  # fmt: skip
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        archives = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(archives) != 1:
            raise RuntimeError(f"npm could not download {PACKAGE} {VERSION}: {done.stderr.strip()[-300:]}")
        yield _unpack(archives[0], Path(folder))


def _unpack(archive: Path, folder: Path) -> Path:
    """What the page needs of the package; RuntimeError for an archive that is not the one it was tried with."""
    digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    if f"sha512-{digest}" != INTEGRITY:
        raise RuntimeError(f"npm downloaded another archive of {PACKAGE} {VERSION} than the one known: sha512-{digest}")
    wanted = {f"package/{name}" for name in ("package.json", *(f"dist/{name}" for name in RUNTIME))}
    with tarfile.open(archive) as opened:
        for member in opened:
            if member.name in wanted and member.isfile():
                target = folder / member.name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(opened.extractfile(member).read())
    return folder / "package"


def _join(names: tuple[str, ...] | list[str]) -> str:
    return "\n".join((HERE / name).read_text("utf-8") for name in names)


def _compute_digest(folder: Path) -> str:
    """Of all files: with another, browsers fetch what they have kept anew."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def _is_ours(path: Path) -> bool:
    """Whether a path, relative to the page's folder, is of a page."""
    return PurePosixPath(path.as_posix()).parts[0] in OURS
