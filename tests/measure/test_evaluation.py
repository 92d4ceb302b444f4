"""Evaluation: the truth scores zero, tables hold one row a query, finished tables are left alone."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from mmgsd.config import EvaluateConfig, TrainConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.em import AS_IT_IS, ModeReadout
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import Mixture
from mmgsd.measure import evaluation, questions
from mmgsd.measure.evaluation import (
    BASELINES,
    check_same_questions,
    evaluate_baseline,
    evaluate_model,
    load_queries,
    summarise,
    write_results,
)
from mmgsd.measure.metrics import LISTS
from mmgsd.measure.questions import choose_points, measure_rmse
from mmgsd.model.network import build_network

CONFIG = EvaluateConfig(pairs=3, points=5)
CLOTH_SIDE_PX = 240.0  # of the synthetic cloths


def ask_baseline(method: str, dataset: Path, out: Path, config: EvaluateConfig = CONFIG) -> pd.DataFrame:
    return load_queries(evaluate_baseline(method, dataset, config, out, progress=False))


def write_weights(folder: Path, content: bytes = b"weights") -> Path:
    """A file that stands for trained weights: the evaluation reads its bytes to know it again."""
    path = folder / "weights.safetensors"
    path.write_bytes(content)
    return path


def answer_with_the_truth(group: str, shift: float) -> object:
    """Stands for a model that knows the labels: the true modes, moved by ``shift`` px along x."""

    def make(matcher: object, data: Dataset, config: EvaluateConfig) -> questions.AnswerFunction:
        def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, torch.Tensor]:
            modes = np.full((len(xy), n.max(), 2), np.nan)
            for row, point in enumerate(choose_points(CONFIG.points, 625)):
                modes[row, : n[row]] = data.xy[second, data.group(group).distinct_modes(point)[::-1]] + [shift, 0]
            covariances = torch.eye(2).repeat(*modes.shape[:2], 1, 1)
            nothing = torch.zeros(len(xy))
            return Mixture(torch.from_numpy(modes), torch.ones(modes.shape[:2]), covariances, nothing), nothing

        return answer

    return make


@pytest.fixture
def ask_oracle(monkeypatch: pytest.MonkeyPatch, cloth_dataset: Path, tmp_path: Path) -> object:
    def ask(group: str = "", *, shift: float = 0.0) -> pd.DataFrame:
        monkeypatch.setattr(evaluation.Matcher, "load", lambda path: None)
        for module in (evaluation, questions):
            monkeypatch.setattr(module, "model_answer", answer_with_the_truth(group, shift))
        out = tmp_path / f"oracle{group}.parquet"
        weights = write_weights(tmp_path)
        return load_queries(evaluate_model(weights, cloth_dataset, CONFIG, out, group=group, progress=False))

    return ask


@pytest.mark.parametrize("group", ["", "identity", "c2", "v4", "d4"])
def test_the_truth_has_no_error(ask_oracle: object, group: str) -> None:
    queries = ask_oracle(group)
    assert (queries.rmse_px == 0).all()
    assert (queries["pck@5px"] == 1).all()


def test_a_shifted_truth_is_wrong_by_the_shift(ask_oracle: object) -> None:
    queries = ask_oracle(shift=3.0)
    np.testing.assert_allclose(queries[["rmse_px", "nearest_px", "best_px"]], 3.0, rtol=1e-5)
    np.testing.assert_allclose(np.concatenate(queries.mahalanobis2), 9.0, rtol=1e-5)
    assert queries.mahalanobis2.map(len).equals(queries.n)


def test_coinciding_modes_are_merged(ask_oracle: object) -> None:
    queries = ask_oracle()  # points 0, 156, 312, 468, 624 of 625: the third is the cloth's centre
    assert queries[queries["pair"] == 0].n.tolist() == [4, 4, 1, 4, 4]


def test_one_row_a_query_about_images_of_different_simulations(cloth_dataset: Path, tmp_path: Path) -> None:
    queries = ask_baseline("centre", cloth_dataset, tmp_path / "centre.parquet")
    assert list(queries.columns) == [
        "pair", "image0", "image1", "point", "visible", "n", "entropy", "hidden", "outside", *LISTS,
        "rmse_px", "nearest_px", "best_px", "swapped", "pck@5px", "pck@10px", "pck@20px", "rmse_seen_px",
    ]  # fmt: skip
    assert len(queries) == CONFIG.pairs * CONFIG.points
    assert not queries.duplicated(["pair", "point"]).any()
    unknown = ["visible", "outside", *LISTS]  # chance has no heatmap
    assert np.isfinite(queries.drop(columns=unknown).to_numpy(dtype=float)).all()
    assert queries.outside.isna().all()
    assert np.isnan(np.concatenate(queries.mahalanobis2)).all()
    episode = load_dataset(cloth_dataset, "test").episode
    assert (episode[queries.image0] != episode[queries.image1]).all()


def test_methods_are_asked_the_same(cloth_dataset: Path, tmp_path: Path) -> None:
    one, two = (ask_baseline(m, cloth_dataset, tmp_path / f"{m}.parquet") for m in ("centre", "random"))
    questions = ["pair", "image0", "image1", "point", "visible", "n"]
    pd.testing.assert_frame_equal(one[questions], two[questions])


def test_the_centres_error_on_a_flat_square(cloth_dataset: Path, tmp_path: Path) -> None:
    queries = ask_baseline("centre", cloth_dataset, tmp_path / "centre.parquet").set_index("point").rmse_px
    corner, inner = CLOTH_SIDE_PX / np.sqrt(2), CLOTH_SIDE_PX / 24 * np.hypot(6, 6)  # 156 is row 6, column 6
    assert queries[0].tolist() == pytest.approx([corner] * 3, abs=1)
    assert queries[156].tolist() == pytest.approx([inner] * 3, abs=1)
    assert queries[312].tolist() == pytest.approx([0] * 3, abs=1)


@pytest.mark.parametrize("method", BASELINES)
def test_classical_descriptors_answer(cloth_dataset: Path, tmp_path: Path, method: str) -> None:
    config = EvaluateConfig(pairs=1, points=3)
    queries = ask_baseline(method, cloth_dataset, tmp_path / f"{method}.parquet", config)
    assert len(queries) == 3
    assert np.isfinite(queries.rmse_px).all()
    assert queries.outside.between(0, 1).all()


def test_hidden_matches_are_counted(cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = load_dataset(cloth_dataset, "test")
    visible = data.visible.copy()
    visible[:, [0, 24]] = False  # two of the four corners
    monkeypatch.setitem(data.__dict__, "visible", visible)
    monkeypatch.setattr(evaluation, "load_dataset", lambda *_: data)
    queries = ask_baseline("centre", cloth_dataset, tmp_path / "centre.parquet")
    assert queries[queries["pair"] == 0].hidden.tolist() == [2, 0, 0, 0, 2]


def test_unknown_baseline(cloth_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="method must .*got 'hog'"):
        ask_baseline("hog", cloth_dataset, tmp_path / "hog.parquet")


def test_a_finished_table_is_left_alone_and_a_damaged_or_another_one_is_asked_again(
    cloth_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "centre.parquet"
    out.write_bytes(b"truncated")
    assert len(ask_baseline("centre", cloth_dataset, out)) == 15
    before = out.stat().st_mtime_ns
    ask_baseline("centre", cloth_dataset, out)
    assert out.stat().st_mtime_ns == before
    assert len(ask_baseline("centre", cloth_dataset, out, EvaluateConfig(pairs=1, points=5))) == 5


def test_other_weights_are_asked_again(ask_oracle: object, cloth_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "oracle.parquet"
    ask_oracle()
    other = evaluation._describe_question(load_dataset(cloth_dataset, "test"), CONFIG, "", "another digest")
    assert load_queries(out).attrs not in ({}, other)


def test_corrected_labels_are_asked_again(cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "test")
    corrected = dataclasses.replace(data, info={**data.info, "labels_sha256": "of other labels"})
    before, after = (evaluation._describe_question(d, CONFIG, "", "sift") for d in (data, corrected))
    assert before != after and before["data"] == after["data"]


def test_overwrite_asks_again(cloth_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "centre.parquet"
    out.write_bytes(b"stale")
    evaluate_baseline("centre", cloth_dataset, CONFIG, out, overwrite=True, progress=False)
    assert len(load_queries(out)) == 15
    assert list(tmp_path.iterdir()) == [out]


def test_points_spread_evenly_and_are_as_many_as_asked_for() -> None:
    assert choose_points(5, 625).tolist() == [0, 156, 312, 468, 624]
    assert [len(choose_points(count, 625)) for count in range(1, 626)] == list(range(1, 626))


def test_summary_separates_visible_sources(tmp_path: Path) -> None:
    shares = dict.fromkeys(["pck@5px", "pck@10px", "pck@20px"], 1.0)
    others = {"nearest_px": 1.0, "best_px": 1.0, "swapped": 0.0, **shares}
    table = pd.DataFrame({"visible": [True, True, False], "rmse_px": [1.0, 3.0, 8.0], **others})
    table.to_parquet(tmp_path / "mmgsd.parquet")
    summary = summarise({"mmgsd": tmp_path / "mmgsd.parquet"})["mmgsd"]
    assert (summary["rmse_mean"], summary["queries"]) == (2.0, 2)
    assert (summary["rmse_mean_all"], summary["queries_all"]) == (4.0, 3)


def test_results_are_json(tmp_path: Path) -> None:
    path = write_results({"cloth": {"mmgsd": {"rmse_mean": 1.5}}}, tmp_path / "new" / "rmse.json")
    assert json.loads(path.read_text()) == {"cloth": {"mmgsd": {"rmse_mean": 1.5}}}
    assert list(path.parent.iterdir()) == [path]


def test_the_validation_error_is_that_of_the_queries(ask_oracle: object, cloth_dataset: Path) -> None:
    ask_oracle(shift=7.0)  # from now on every model answers 7 px beside the truth
    matcher = SimpleNamespace(config=TrainConfig())
    assert measure_rmse(matcher, load_dataset(cloth_dataset), pairs=3, points=CONFIG.points) == pytest.approx(7, 1e-5)


def test_modes_are_read_as_round_as_the_training_says(cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = TrainConfig(input_px=64, descriptor_dim=4, roundness=0.07)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), config, modes=4, size=(485, 485), device="cpu")
    asked, read = [], questions.read_heatmap

    def listen(*arguments: object, readout: ModeReadout) -> tuple[Mixture, torch.Tensor]:
        asked.append(readout.shape_prior)
        return read(*arguments, readout=readout)

    monkeypatch.setattr(questions, "read_heatmap", listen)
    measure_rmse(matcher, load_dataset(cloth_dataset), pairs=2, points=5)
    assert asked == [0.07, 0.07]


@pytest.fixture
def untrained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What stands for the weights of an untrained network."""
    config = dataclasses.replace(TrainConfig(), input_px=64, descriptor_dim=4)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), config, modes=4, size=(485, 485), device="cpu")
    monkeypatch.setattr(evaluation.Matcher, "load", lambda path: matcher)
    return write_weights(tmp_path)


def test_a_model_answers_every_query(cloth_dataset: Path, tmp_path: Path, untrained: Path) -> None:
    out = evaluate_model(untrained, cloth_dataset, CONFIG, tmp_path / "mmgsd.parquet", group="d4", progress=False)
    queries = load_queries(out)
    assert np.isfinite(queries.rmse_px).all()
    assert queries[queries["pair"] == 0].n.tolist() == [4, 4, 1, 4, 4]  # points of a diagonal under d4


def test_of_further_modes_the_most_probable_one_is_the_answer(
    cloth_dataset: Path, tmp_path: Path, untrained: Path
) -> None:
    def ask(name: str, **how: object) -> pd.DataFrame:
        out = tmp_path / f"{name}.parquet"
        return load_queries(evaluate_model(untrained, cloth_dataset, CONFIG, out, progress=False, **how))

    own, every = ask("own", group="identity", modes=4), ask("all", group="c4", modes=4)
    assert (own.n == 1).all() and np.allclose(own.rmse_px, own.nearest_px)
    assert (own.nearest_px >= every.nearest_px - 1e-6).all() and (own.nearest_px > every.nearest_px).any()
    assert not np.allclose(own.rmse_px, ask("mean", group="identity").rmse_px)
    with pytest.raises(ValueError, match="modes must .*got -1"):
        ask("own", modes=-1)


def test_a_point_that_sticks_out_of_the_image_is_asked_at_its_border(cloth_dataset: Path) -> None:
    answer = evaluation._classical_answer("sift", AS_IT_IS, load_dataset(cloth_dataset, "test"))
    xy, four = np.float32([[-2.5, 120], [-0.5, 120]]), np.array([4, 4])
    outside, border = answer(0, 1, xy, four)[0].modes
    torch.testing.assert_close(outside, border)


def test_weights_of_another_object_are_refused(cloth_dataset: Path, tmp_path: Path, untrained: Path) -> None:
    matcher = evaluation.Matcher.load(untrained)
    matcher.object = "rope"
    with pytest.raises(ValueError, match="weights must .*got weights of 'rope'"):
        evaluate_model(untrained, cloth_dataset, CONFIG, tmp_path / "out.parquet", progress=False)
    assert not (tmp_path / "out.parquet").exists()
    matcher.object = ""  # unknown
    evaluate_model(untrained, cloth_dataset, CONFIG, tmp_path / "out.parquet", progress=False)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"temperature": -1.0}, "temperature must be finite and greater than 0, got -1.0"),
        ({"temperature": float("nan")}, "temperature must be finite and greater than 0, got nan"),
        ({"modes": 10**6}, "modes must be an integer from 1 to 64, got 1000000"),
    ],
)
def test_what_cannot_be_asked(cloth_dataset: Path, tmp_path: Path, untrained: Path, asked: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate_model(untrained, cloth_dataset, CONFIG, tmp_path / "out.parquet", progress=False, **asked)


def test_answers_to_other_questions_are_not_compared(cloth_dataset: Path, tmp_path: Path) -> None:
    tables = {method: ask_baseline(method, cloth_dataset, tmp_path / method) for method in ("centre", "random")}
    check_same_questions(tables)
    tables["random"] = tables["random"].assign(point=tables["random"].point + 1)
    with pytest.raises(ValueError, match="tables must .*got other ones of 'random' than of"):
        check_same_questions(tables)
