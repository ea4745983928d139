"""How a command ends when something is wrong."""

from __future__ import annotations

import pytest

from experiments.errors import in_a_line


@pytest.mark.parametrize("error", [ValueError("no such tag"), FileNotFoundError("no such tag")])
def test_what_can_be_mended_is_said_in_a_line(error: Exception) -> None:
    with pytest.raises(SystemExit, match=r"^trace: no such tag$") as said, in_a_line("trace"):
        raise error
    assert said.value.__cause__ is error


def test_other_errors_are_not_hidden_but_for_those_named() -> None:
    with pytest.raises(RuntimeError), in_a_line("trace"):
        raise RuntimeError("a defect")
    with pytest.raises(SystemExit, match="trace: diverged"), in_a_line("trace", RuntimeError):
        raise RuntimeError("diverged")


def test_the_place_is_shown_on_demand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="no such tag"), in_a_line("trace"):
        raise ValueError("no such tag")


def test_ctrl_c_ends_with_its_own_status(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as said, in_a_line("trace"):
        raise KeyboardInterrupt
    assert said.value.code == 130
    assert "trace: interrupted" in capsys.readouterr().out
