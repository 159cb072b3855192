"""Any command line composes to a configuration or gives an error of one sentence."""

from __future__ import annotations

import contextlib
import io
import sys
import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from lp_framework import cli

FUZZ = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

KEYS = [
    *("seed", "checkpoint", "views", "protocol", "solver", "solver.gamma", "solver.iterations", "solver.name", "start"),
    *("start.count", "data", "data.path", "data.image_size", "prior", "prior.path", "renderer", "trainer.precision"),
    *("experiment", "hydra.run.dir", "hydra.job.name", "hydra/launcher", "hydra.mode", "hydra.sweep.dir"),
    *("hydra.verbose", "plugins", "solvers", "solver.gama", "data.pth", "model", "a.b.c", "solver.gamma.x", "data/toy"),
    "solver@prior",
]  # fmt: skip
VALUES = [
    *("0", "-1", "0.3", "1e400", "nan", "9" * 400, "true", "null", "", "toy", "langevin", "two_stage", "grid"),
    *("lanjevin", "[0,0.3,0]", "[1,", "{a:1}", "{a:", "[[[[]]]]", "'quoted'", "'open", '"', "a=b", "a b", "0,1"),
    *("${seed}", "${nothing}", "${oc.env:NO_SUCH}", "${", "${solver.gamma}", "???", "range(1,3)", "${solver}", "\\"),
    "x(0,1)",
    *("ñ", "位姿", "\U0001f600", "\ud800", "\x00", "\n", "a\nb", "..", "/", "[a:b]", "glob(*)", "!!python/name:os"),
]  # fmt: skip


@st.composite
def near(draw: st.DrawFn, word: str) -> str:
    """A word with a letter too many, too few or other."""
    at = draw(st.integers(0, len(word)))
    letter = draw(st.sampled_from(["", "x", ".", "_", "-", "é", " ", "/", "@"]))
    return word[:at] + letter + word[at + draw(st.integers(0, 1)) :]


WORDS = st.sampled_from(KEYS)
KEY = st.one_of(WORDS, WORDS.flatmap(near), st.text(max_size=6))
VALUE = st.one_of(st.sampled_from(VALUES), st.text(max_size=8), st.integers().map(str), st.floats().map(str))
OVERRIDE = st.one_of(
    st.tuples(
        st.sampled_from(["", "", "", "+", "++", "~"]), KEY, st.sampled_from(["=", "=", "=", "", "=="]), VALUE
    ).map("".join),
    st.text(max_size=12),
    st.sampled_from(["--help", "--multirun", "--cfg", "--resolve", "--package", "--info", "--nonsense", "-x", "--"]),
)  # fmt: skip


@pytest.mark.usefixtures("lp")
@FUZZ
@given(command=st.sampled_from(["eval", "train", "estimate"]), overrides=st.lists(OVERRIDE, min_size=1, max_size=3))
def test_a_command_line_composes_or_gives_one_sentence(command, overrides):
    argv, sys.argv = sys.argv, ["lp", command, *overrides, "--cfg", "job"]
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    err = io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                status = cli.main()
            except SystemExit as stop:  # Hydra's own, of --help and of its parser of options
                status = stop.code
    finally:
        sys.argv = argv
    out.flush()
    if status == 0:
        assert {"--help", "--info"} & {*overrides} or OmegaConf.create(out.buffer.getvalue().decode()) is not None
    else:
        assert status in (1, 2)
        *warned, error = err.getvalue().splitlines()
        assert error.startswith(("error: ", "package ")), err.getvalue()  # the second one is Hydra's, of --package
        assert all(line.startswith("warning: ") for line in warned), err.getvalue()
