"""Configurations: presets load, whatever is wrong stops at once, digests tell configurations apart."""

from __future__ import annotations

import dataclasses
import re

import pytest

from mmgsd.config import OBJECTS, EvaluateConfig, RenderConfig, TrainConfig, digest, from_dict, load_preset, to_dict

OTHER = {  # another accepted value for the fields that are no plain numbers or flags
    "object": "cloth", "method": "pcl", "group": "identity", "network": "lite0", "trunk_weights": "w.safetensors",
    "schedule": "step", "optimiser": "muon", "rotation_deg": 45.0, "bend": 0.25, "groups": 2, "roles": 2,
    "scene": "workspace", "also": "workspace",
}  # fmt: skip
CONFIGS = (RenderConfig(object="rope"), TrainConfig(object="rope", network="lite0x2"), EvaluateConfig(points=600))
FIELDS = [(config, field.name) for config in CONFIGS for field in dataclasses.fields(config)]


@pytest.mark.parametrize("name", ["smoke", "quick", "paper", "workspace"])
def test_preset_configures_both_objects(name: str) -> None:
    preset = load_preset(name)
    assert preset.name == name
    for part in (preset.render, preset.train, preset.ablation):
        assert {key: value.object for key, value in part.items()} == {o: o for o in OBJECTS}


def test_the_workspace_preset_differs_from_the_papers_in_the_scene_alone() -> None:
    paper, workspace = load_preset("paper"), load_preset("workspace")
    assert workspace.render == {o: dataclasses.replace(r, scene="workspace") for o, r in paper.render.items()}
    assert workspace.train == paper.train


def test_what_is_stored_of_a_plain_scene_is_what_was_stored_before_there_was_another() -> None:
    stored = to_dict(RenderConfig(object="rope"))
    assert sorted(stored) == [
        "ball", "object", "rotation_deg", "samples", "seed", "test_images", "train_images", "views",
    ]  # fmt: skip
    assert from_dict(RenderConfig, stored) == RenderConfig(object="rope")
    assert to_dict(RenderConfig(scene="workspace"))["scene"] == "workspace"


def test_paper_preset_has_the_papers_sizes() -> None:
    preset = load_preset("paper")
    assert {(r.train_images, r.test_images, r.size) for r in preset.render.values()} == {
        (3500, 500, (485, 485)),
        (3500, 500, (640, 480)),
    }
    assert (preset.evaluate.pairs, preset.evaluate.points) == (500, 625)


def test_unknown_preset_names_the_accepted_ones() -> None:
    with pytest.raises(ValueError, match="preset must .*got 'papr'"):
        load_preset("papr")


@pytest.mark.parametrize(("kind", "name", "value", "accepted"), [
    (TrainConfig, "sigma_px", -1.0, "greater than 0"), (TrainConfig, "sigma_px", 0, "greater than 0"),
    (TrainConfig, "sigma_px", float("nan"), "a finite float"), (TrainConfig, "margin", float("inf"), "a finite float"),
    (TrainConfig, "weight_decay", -0.1, "at least 0"), (TrainConfig, "steps", "200", "int"),
    (TrainConfig, "steps", 2.5, "int"), (TrainConfig, "steps", True, "int"), (TrainConfig, "steps", 0, "at least 1"),
    (TrainConfig, "augment", 1, "bool"), (TrainConfig, "batch", 1, "at least 2"),
    (TrainConfig, "non_matches", 1, "at least 2"), (TrainConfig, "input_px", 32, "at least 64 for 'lite0'"),
    (TrainConfig, "roundness", 0.0, "greater than 0"), (TrainConfig, "seed", -1, "at least 0"),
    (TrainConfig, "method", "mmgds", "one of 'pcl', .*did you mean 'mmgsd'"),
    (TrainConfig, "network", "vgg", "one of .*'lite0'.*'resnet34'"),
    (TrainConfig, "optimiser", "adam", "one of 'adamw', 'muon'"), (TrainConfig, "schedule", "none", "one of 'cosine'"),
    (TrainConfig, "bend", 0.6, r"in \[0, 0.5\]"), (TrainConfig, "groups", 5, "a divisor of batch and pairs"),
    (TrainConfig, "prototype_weight", -0.5, "at least 0, or -1"), (RenderConfig, "train_images", 0, "at least 1"),
    (RenderConfig, "rotation_deg", 181.0, r"in \(0, 180\]"),
    (RenderConfig, "ball", True, "False for a cloth"), (RenderConfig, "seed", -1, "at least 0"),
    (RenderConfig, "object", "../towel", "'cloth', 'rope' or the name of a file in data/objects"),
    (RenderConfig, "scene", "workspaces", "one of 'plain', 'workspace'"),
    (EvaluateConfig, "points", 626, "between 1 and 625"), (EvaluateConfig, "pairs", 0, "at least 1"),
    (EvaluateConfig, "seed", -1, "at least 0"),
])  # fmt: skip
def test_wrong_value_names_argument_and_what_is_accepted(kind: type, name: str, value: object, accepted: str) -> None:
    with pytest.raises(ValueError, match=rf"{name} must be {accepted}.*, got {re.escape(repr(value))}"):
        kind(**{name: value})


@pytest.mark.parametrize(("values", "message"), [
    ({"input_px": 96, "network": "lite0x2fine"}, "input_px must be at least 128 for 'lite0x2fine'"),
    ({"groups": 16, "pairs": 64}, "groups must be .* at least 2 of 16 images"),
])  # fmt: skip
def test_values_must_fit_together(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainConfig(**values)


@pytest.mark.parametrize("kind", [RenderConfig, TrainConfig])
@pytest.mark.parametrize("name", [
    "washcloth", "dishcloth", "ropes", "cloths", "towel2", "My_Towel", "tshirt", "cloth-blue", "a", "model", "samples",
])  # fmt: skip
def test_an_object_may_have_any_name_that_is_free(kind: type, name: str) -> None:
    assert kind(object=name).object == name


@pytest.mark.parametrize("kind", [RenderConfig, TrainConfig])
@pytest.mark.parametrize("name", [
    "models", "queries", "notebooks", "sample", "experiments", "Models", "Cloth", "ROPE", "cloth-spcl", "rope-broken",
])  # fmt: skip
def test_a_name_that_is_taken_is_refused(kind: type, name: str) -> None:
    with pytest.raises(ValueError, match=f"object must .*got '{name}'"):
        kind(object=name)


@pytest.mark.parametrize("name", ["", "a b", "a/b", "../towel", "a.json", ".hidden", "-a", "2", "a\n", "ü", "a" * 61])
def test_a_name_that_is_none_of_a_file_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="object must"):
        RenderConfig(object=name)


def test_unknown_key_names_the_nearest_one() -> None:
    with pytest.raises(ValueError, match="a key of TrainConfig must be one of .*did you mean 'sigma_px'.*got 'sigma'"):
        from_dict(TrainConfig, {"sigma": 1.0})


def test_stored_values_give_the_same_configuration() -> None:
    config = TrainConfig(object="rope", method="spcl", steps=7)
    assert from_dict(TrainConfig, dataclasses.asdict(config)) == config


@pytest.mark.parametrize(("config", "name"), FIELDS, ids=[f"{type(c).__name__}.{n}" for c, n in FIELDS])
def test_digest_changes_with_every_field(config: RenderConfig | TrainConfig | EvaluateConfig, name: str) -> None:
    value = getattr(config, name)
    other = OTHER[name] if name in OTHER else (not value if isinstance(value, bool) else value + 1)
    config = dataclasses.replace(config, method="spcl") if name == "hidden_matches" else config
    assert digest(dataclasses.replace(config, **{name: other})) != digest(config)


def test_integer_and_float_are_one_configuration() -> None:
    assert digest(TrainConfig(sigma_px=1)) == digest(TrainConfig(sigma_px=1.0))


def test_the_objects_own_group_is_filled_in() -> None:
    assert TrainConfig(object="rope").group == "c2"
    assert digest(TrainConfig()) == digest(TrainConfig(group="c4"))
