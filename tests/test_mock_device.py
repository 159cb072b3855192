"""Run the checks of `on_mock_device.py` in a separate process, because PyTorch cannot unregister a device."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from torch.utils import backend_registration

CHECKS = Path(__file__).with_name("on_mock_device.py")


@pytest.mark.heavy
@pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch does not support devices written in Python",
)
def test_commands_and_solvers_run_on_another_device(tmp_path):
    # Without conftest.py, which ignores the file; `-p lp_framework` makes torchvision importable.
    options = ["--quiet", "--noconftest", "-p", "lp_framework", "-p", "no:cacheprovider", f"--basetemp={tmp_path}"]
    line = [sys.executable, "-m", "pytest", "-o", "addopts=--import-mode=importlib", *options, str(CHECKS)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(line, cwd=CHECKS.parents[1], env=environment, capture_output=True, text=True, timeout=900)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert re.search(r"^\d\d passed", ran.stdout.splitlines()[-1]), ran.stdout
