"""Models by the range of poses: what is trained and asked, that a killed run goes on, and what is concluded."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch

from mmgsd.config import OBJECTS
from mmgsd.learn import losses
from mmgsd.measure.evaluation import read_results
from mmgsd.paths import Paths
from mmgsd.studies import matrix, pose_range
from mmgsd.studies.claims import HELD, IN_PART, NOT_HELD, NOT_MEASURED
from mmgsd.studies.table import to_markdown


def make_results(**gaps: float) -> dict:
    """Three seeds of MMGSD and Unimodal, the latter with so many px more within each limit: ``within15=20.0``."""
    def row(error: float) -> dict:
        errors = {"rmse_mean": error, "nearest_mean": error / 2, "pck@20px": 0.5}
        return {"within": errors, "any": errors}

    arms = [(method, seed) for method in ("mmgsd", "unimodal") for seed in range(3)]
    one = {name[6:]: {f"{method}-{seed}": row(40.0 + seed + more * (method == "unimodal")) for method, seed in arms}
           for name, more in gaps.items()}  # fmt: skip
    return {"pose_range": dict.fromkeys(OBJECTS, one)}


CONJECTURE = dict(within15=30.0, within45=20.0, within90=10.0, within180=1.0)


@pytest.mark.parametrize(("changed", "verdict"), [
    ({}, HELD),
    ({"within45": 1.5}, NOT_HELD),  # within the margin
    ({"within180": 25.0}, NOT_HELD),  # as large a gap at any pose
])  # fmt: skip
def test_conjecture_needs_a_gap_at_both_narrow_limits_and_a_smaller_one_at_any_pose(changed, verdict):
    assert pose_range.judge_one_match(make_results(**CONJECTURE | changed)).verdict == verdict


def test_what_was_not_run_is_not_judged():
    assert pose_range.judge_one_match({}).verdict == NOT_MEASURED
    half = make_results(**CONJECTURE)
    del half["pose_range"]["rope"]
    assert pose_range.judge_one_match(half).verdict == IN_PART


def test_table_has_spread_and_p_of_each_limit_and_figure_its_seeds():
    results = make_results(**CONJECTURE)["pose_range"]
    lines = to_markdown(pose_range.describe_limits(results)).splitlines()
    cloth = [line for line in lines if "±15°, Unimodal" in line]
    assert "71.0 ± 1.0 (3)" in cloth[0] and "50 %" in cloth[0]
    assert pose_range.describe_limits(results).rows["±15°, Unimodal"]["cloth"]["p"] == "<0.001"
    assert len(pose_range.plot_limits(results).axes) == 2
    assert pose_range.plot_limits({}) is None


def test_models_differ_in_method_and_seed_and_are_never_turned():
    models = pose_range.list_models("quick", "rope", 2)
    assert list(models) == [f"{m}-{s}" for m in pose_range.METHODS for s in (0, 1)]
    assert not any(model.rotate for model in models.values())
    assert len({model.name for model in models.values()}) == len(models)


@pytest.mark.parametrize(("name", "value"), [("seeds", 0), ("objects", "towel"), ("folds", -1)])
def test_options_are_checked_before_anything_is_rendered(tmp_path, name, value):
    with pytest.raises(ValueError, match=name):
        pose_range.check(Paths(tmp_path, "smoke"), **{name: value})


def test_run_trains_within_each_limit_asks_both_and_goes_on(tmp_path, tiny_dataset, monkeypatch):
    rendered, trained = {}, []
    data = tiny_dataset(object="cloth", n_train=6, n_test=4)

    def render(config, folder: Path) -> Path:
        rendered[folder] = config.rotation_deg
        return data

    def train(actual, model, images, folder, *, progress):
        trained.append(folder)
        return actual(model, images, folder, progress=False)

    monkeypatch.setattr(pose_range, "render_dataset", render)
    monkeypatch.setattr(matrix, "train_model", partial(train, matrix.train_model))
    monkeypatch.setattr(matrix, "PROCESSES", 1)  # other processes would not see what is replaced here
    monkeypatch.setattr(pose_range, "LIMITS_DEG", (15, 180))
    monkeypatch.setattr(pose_range, "METHODS", ("mmgsd", "unimodal"))
    paths = Paths(tmp_path, "smoke")
    file = pose_range.run(paths, seeds=1, objects="cloth", folds=0)
    rows = read_results(file, depth=3)["cloth"]
    assert {limit: set(row) for limit, row in rows.items()} == dict.fromkeys(("15", "180"), {"mmgsd-0", "unimodal-0"})
    assert set(rows["15"]["mmgsd-0"]) == {"within", "any", "run"}
    assert rendered == {paths.generated / "pose_range" / "cloth-15": 15, paths.dataset("cloth"): 180}
    assert len(set(trained)) == 4
    trained.clear()
    pose_range.run(paths, seeds=1, objects="cloth", folds=0)
    assert not trained
    folded = []

    def fold(bench, policies, rollouts) -> dict:
        folded.append([policy.weights.parent.name for policy in policies])
        assert {rollout.turn_deg for rollout in rollouts} == {15 if "15" in folded[-1][0][-3:] else 180}
        return {policy.name: {"mean": 0.5, "count": len(rollouts)} for policy in policies}

    monkeypatch.setattr(pose_range, "measure_success", fold)
    for _ in range(2):
        pose_range.run(paths, seeds=1, objects="cloth", folds=3)
    assert [len(names) for names in folded] == [2, 2] and all("-within-" in name for names in folded for name in names)
    rows = read_results(file, depth=3)
    assert rows["cloth"]["15"]["mmgsd-0"]["folds"] == {"mean": 0.5, "count": 3, "rollouts": 3}
    assert pose_range.describe_limits(rows).rows["±15°, MMGSD"]["cloth"]["folds"] == "50 % of 3"
    assert (paths.figures / "pose_range.png").is_file()


def test_mean_loss_of_one_match_is_that_of_all():
    """The report's proposition: over equally probable labellings, for any prediction."""
    xs = ys = torch.linspace(5, 95, 10)
    squared = torch.rand(1, 1, 100, generator=torch.Generator().manual_seed(0)) * 9
    modes = torch.tensor([[20.0, 20.0], [80.0, 20.0], [80.0, 80.0], [20.0, 80.0]])
    ones = [losses.compute_target(mode[None, None, None], torch.ones(1, 1, 1, dtype=torch.bool), xs, ys, 4.0)
            for mode in modes]  # fmt: skip
    every = losses.compute_target(modes[None, None], torch.ones(1, 1, 4, dtype=torch.bool), xs, ys, 4.0)
    mean = torch.stack([losses.mmgsd(squared, one) for one in ones]).mean()
    torch.testing.assert_close(mean, losses.mmgsd(squared, every))


def test_the_finding_tells_both_objects_and_what_was_not_measured():
    found = pose_range.count_finding(make_results(**CONJECTURE))
    assert found == {"cloth": "33 % *", "rope": "33 % *", "seeds": "3"}
    narrow = pose_range.count_finding(make_results(**CONJECTURE | {"within45": 0.5}))
    assert narrow["cloth"] == "1 %"  # less than seeds differ by
    assert pose_range.count_finding({}) == {"cloth": "–", "rope": "–", "seeds": "0"}
