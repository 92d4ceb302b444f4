"""The table of joint answers: a row an object, set and state, shares in per cent, dashes for what no question had."""

from __future__ import annotations

from mmgsd.studies.joint import describe_joint, make_joint_sentence
from mmgsd.studies.table import to_markdown

SAID = {"questions": 6, "heaviest": 0.02, "possible": 0.5, "joint": 0.4, "any_joint": 0.35, "swaps_heaviest": 0.8,
        "swaps_joint": None}  # fmt: skip
ROWS = {"cloth": {"object": "cloth", "paper": {"all": SAID, "folded": SAID}, "workspace": {"all": SAID, "folded": SAID},
                  "milliseconds": {"joint": 220, "alone": 90}, "hardware": "CPU, 1 of 2 cores"}}  # fmt: skip


def test_rows_are_object_set_and_state() -> None:
    lines = to_markdown(describe_joint(ROWS)).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| cloth, clean", "| cloth, clean, folded",
                                                            "| cloth, cluttered"]  # fmt: skip
    assert lines[2] == "| cloth, clean | 2 % | 40 % | 35 % | 50 % | 80 % | – |"


def test_questions_and_cost_are_said() -> None:
    assert make_joint_sentence(ROWS) == (
        "12 questions. A joint answer takes up to 130 ms more than one that is not (CPU with bfloat16, 1 of 2 cores)."
    )
