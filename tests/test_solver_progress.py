"""Progress bars of solver steps: only on a terminal and inside `shown_progress`."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from lp_framework.solvers import progress
from lp_framework.solvers.progress import shown_progress, steps_of


@pytest.mark.parametrize("terminal", [True, False])
def test_steps_have_a_bar_where_somebody_watches(monkeypatch, terminal):
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda stderr: Console(file=screen, force_terminal=terminal, width=80))
    assert list(steps_of(3, "outside")) == [0, 1, 2]
    with shown_progress():
        assert list(steps_of(3, "descending")) == [0, 1, 2]
        assert list(steps_of(0, "nothing")) == []
    assert list(steps_of(2, "after")) == [0, 1]
    shown = screen.getvalue()
    assert "outside" not in shown and "after" not in shown
    assert ("descending" in shown and "3/3" in shown) == terminal
