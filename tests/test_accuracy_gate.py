"""The accuracy gate: two small recordings, traced end to end, score as recorded, or better."""

from __future__ import annotations

import json

import accuracy_gate
import pytest


def test_every_case_is_recorded_and_has_a_figure() -> None:
    recorded = json.loads(accuracy_gate.RECORDED.read_text())
    assert set(recorded) == set(accuracy_gate.CASES)
    for name, score in recorded.items():
        # Scores near zero would let everything pass.
        assert min(score[one] for one in accuracy_gate.SCORES) > 0.3, name
        assert score["frames"] >= 40, name


@pytest.mark.ci
@pytest.mark.parametrize("name", accuracy_gate.CASES)
def test_scores_are_at_least_the_recorded_ones(name: str, tmp_path) -> None:
    recorded = json.loads(accuracy_gate.RECORDED.read_text())[name]
    found = accuracy_gate.scores(accuracy_gate.CASES[name], tmp_path)
    assert found["frames"] == recorded["frames"]
    for score in accuracy_gate.SCORES:
        assert found[score] >= recorded[score] - accuracy_gate.MARGIN, (
            f"{name}: {score} is {found[score]}; expected at least the recorded {recorded[score]} less "
            f"{accuracy_gate.MARGIN}. If the change is meant, record anew: python tests/accuracy_gate.py --record"
        )
