"""Tables of the shipped weights: what was not measured is a dash, photographs are counted, their sources named."""

from __future__ import annotations

from mmgsd.studies.backbones import describe_backbones
from mmgsd.studies.shipped import (
    describe_cloth_renders,
    describe_knowledge,
    describe_limits,
    describe_pictures,
    describe_readings,
    describe_rounds,
    describe_sources,
    list_names,
    make_counts_sentence,
    make_reading_sentence,
)
from mmgsd.studies.table import to_markdown

FOUND = {"photographs": 34, "found@5%": 0.512, "spurious": 0.25, "unanswered": 0.306, "best": 8.04, "marks": "new",
         "intervals": {"found@5%": [0.4, 0.62]}, "sources": {"a/b": {}, "c/d": {}}}  # fmt: skip
HEADS = {"mask_iou": 0.951, "auroc_visible": 0.9, "auroc_on_object": 0.98, "auroc_absent": None}
SET = {
    "rmse_mean": 21.04, "heads": HEADS, "auroc_absent": 0.3, "ece": 0.0264, "ece_confidence": 0.01,
    "within_radius": 0.91, "asked": {"by_name": 16.59},
}  # fmt: skip
ROWS = {
    "cloth-orb": {"paper": {"rmse_mean": 71.25}},
    "cloth-paper": {"calibrated": False, "paper": {"rmse_mean": 26.1}, "workspace": {"rmse_mean": 88.0}},
    "cloth": {"calibrated": True, "paper": SET, "workspace": SET, "photographs": FOUND, "milliseconds": 120.4,
              "hardware": "CPU, 2 cores", "object": "cloth", "side_px": 300.0},
    "rope": {"calibrated": True, "photographs": FOUND | {"photographs": 32}, "milliseconds": 140.4,
             "hardware": "CPU, 2 cores", "object": "rope", "side_px": 400.0},
}  # fmt: skip


def test_rows_are_in_the_order_of_interest() -> None:
    assert list_names(ROWS, "cloth") == ["cloth", "cloth-paper", "cloth-orb"]


def test_what_was_not_measured_is_a_dash() -> None:
    lines = to_markdown(describe_pictures(ROWS)).splitlines()
    assert lines[2] == "| cloth, `cloth` | 21.0 | 21.0 | 51 % (40 to 62) | 25 % | 31 % | 8.0 % |"
    assert lines[3] == "| cloth, `cloth-paper` | 26.1 | 88.0 | – | – | – | – |"
    assert lines[4] == "| cloth, ORB | 71.2 | – | – | – | – | – |"
    named = ROWS | {"cloth": ROWS["cloth"] | {"photographs": FOUND | {"by_name": FOUND | {"found@5%": 0.62}}}}
    added = to_markdown(describe_pictures(named)).splitlines()[3]
    assert added == "| cloth, `cloth`, by name | – | – | 62 % (40 to 62) | 25 % | 31 % | 8.0 % |"
    assert len({line.count("|") for line in lines}) == 1


def test_one_table_has_one_reading_and_one_set_of_marks() -> None:
    own, means = {"power": 1.0, "sharpness": 6.0}, {"power": 1.0, "sharpness": 1.0}
    rows = {
        "cloth": ROWS["cloth"] | own, "cloth-paper": ROWS["cloth-paper"] | means | {"photographs": FOUND},
        "cloth-paper@1,6": own | {"photographs": FOUND | {"found@5%": 0.64, "intervals": {}}},
        "cloth-orb": {"photographs": FOUND}, "cloth-imagenet@1,6": own | {"photographs": FOUND | {"marks": "old"}},
        "rope": ROWS["rope"] | own,
    }  # fmt: skip
    assert list_names(rows, "cloth") == ["cloth", "cloth-paper@1,6", "cloth-imagenet@1,6"]
    lines = to_markdown(describe_pictures(rows)).splitlines()
    assert lines[3:5] == ["| cloth, `cloth-paper` | – | – | 64 % | 25 % | 31 % | 8.0 % |",
                          "| cloth, ImageNet features | – | – | – | – | – | – |"]  # fmt: skip
    assert "power 1, sharpness 6 (cloth)" in make_reading_sentence(rows)


def test_others_renders_are_beside_what_the_paper_says_of_its_own() -> None:
    found = {"rmse_mean": 31.71, "median": 27.7, "pck@20px": 0.35}
    lines = to_markdown(describe_cloth_renders(ROWS | {"cloth": ROWS["cloth"] | {"cloth_renders": found}})).splitlines()
    assert lines[2] == "| `cloth` | 31.7 | 27.7 | 35 % |" and "32.4" in lines[3] and len(lines) == 4


OWN = "| cloth, `cloth`, power 1.5, sharpness 4"


def test_ways_of_reading_stand_beside_the_weights_own() -> None:
    means, own = {"power": 1.0, "sharpness": 1.0}, {"power": 1.5, "sharpness": 4.0}
    rows = {
        "rope": {**own}, "cloth-spcl@1,6": {**own, "cloth_renders": {}},
        "cloth@1,1": {**means, "paper": {"rmse_mean": 25.6}},
        "cloth": {**own, **ROWS["cloth"], "shrinkage": 0.5},
        "cloth@1.5,4,0": {**own, "paper": {"rmse_mean": 23.0}, "shrinkage": 0.0},
    }  # fmt: skip
    lines = to_markdown(describe_readings(rows)).splitlines()
    assert lines[2:] == [
        f"{OWN}, shrinkage 0.5 | 21.0 | 21.0 | 51 % (40 to 62) | 25 % | 31 % | 8.0 % |",
        "| cloth, `cloth`, power 1, sharpness 1 | 25.6 | – | – | – | – | – |",
        f"{OWN}, shrinkage 0 | 23.0 | – | – | – | – | – |",
    ]


def test_knowledge_is_of_weights_alone() -> None:
    lines = to_markdown(describe_knowledge(ROWS)).splitlines()
    assert lines[2] == "| `cloth`, clean | 0.95 | 0.90 | 0.98 | – | 0.026 | 0.010 | 0.91 | – | 16.6 |"
    assert not any("orb" in line.lower() for line in lines)


def test_a_sentence_counts_the_photographs() -> None:
    said = make_counts_sentence(ROWS)
    assert "34 of cloths and 32 of ropes" in said and "takes 140 ms (CPU with bfloat16, 2 cores)" in said


def test_each_repository_is_a_row_and_what_it_lacks_a_dash() -> None:
    found = {"queries": 12, "unanswered": 0.2, "found@5%": 0.4477, "found@10%": 0.83, "spurious": 0.3, "best": 11.96}
    rows = {"cloth": {"photographs": {"sources": {"a/b": found}}}, "rope": {"photographs": {"sources": {"c/d": {}}}}}
    lines = to_markdown(describe_sources(rows)).splitlines()
    assert lines[2:] == [
        "| cloth, `a/b` | 12 | 20 % | 45 % | 83 % | 30 % | 12.0 % |",
        "| rope, `c/d` | – | – | – | – | – | – |",
    ]


def test_each_round_is_a_row_and_its_steps_are_those_so_far() -> None:
    unseen = {"alone": {"clean": 20.15, "cluttered": 47.38}, "averaged": {"clean": 19.73, "cluttered": 47.01}}
    found = {"found@5%": 0.776, "spurious": 0.195, "by_name": {"found@5%": 0.827, "spurious": 0.17}}
    rows = {"2": {"run": {"steps": 4000}, "unseen": unseen, "photographs": found}, "1": {"run": {"steps": 3000}}}
    lines = to_markdown(describe_rounds({"cloth": rows})).splitlines()
    assert lines[2] == "| cloth, 1 | 3000 |" + " – |" * 8
    assert lines[3] == "| cloth, 2 | 7000 | 20.1 | 47.4 | 19.7 | 47.0 | 78 % | 20 % | 83 % | 17 % |"


def test_limits_are_in_px_shares_of_the_side_and_milliseconds() -> None:
    lines = to_markdown(describe_limits(ROWS)).splitlines()
    assert "| mean error, clean renders | cloth 21 px, 7 % of its side; rope –, – of its length |" in lines
    assert "| mean error, cluttered renders | cloth 21 px; rope – |" in lines  # whose side is another
    assert "cloth 17 px where a picture gives –" in lines[5]
    assert "– of a cloth's corners by name, 51 % by another picture" in lines[7]
    assert "140 ms" in lines[8] and "never tried" in lines[9]
    unsized = ROWS | {"cloth": {key: value for key, value in ROWS["cloth"].items() if key != "side_px"}}
    assert "cloth 21 px, – of its side" in to_markdown(describe_limits(unsized))


def test_trunks_stand_beside_each_other_with_their_time() -> None:
    rows = ROWS | {"cloth-dinov2s": {"paper": SET, "milliseconds": 884.8}, "rope-light": {"workspace": SET}}
    lines = to_markdown(describe_backbones(rows)).splitlines()
    assert lines[0].endswith("| cluttered: RMSE px | ms a question |")
    assert lines[2:] == ["| cloth, DINOv2 ViT-S/14, frozen | 21.0 | – | 885 |",
                         "| rope, EfficientNet-Lite0, trained | – | 21.0 | – |"]  # fmt: skip
