"""What is read of a built-in's constructor from its source is what the class itself says."""

from __future__ import annotations

import inspect
import subprocess
import sys
import typing
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from lp_framework import registry
from lp_framework.composition import _schema
from lp_framework.constructors import outline
from lp_framework.registry_sources import built_ins

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("key", sorted(built_ins()), ids="=".join)
def test_an_outline_has_the_settings_types_and_defaults_of_the_class(key):
    made, real = outline(key), registry.get(*key)
    assert made is not None and made.__name__ == real.__name__
    settings, _ = registry._parameters(real)
    if settings:
        kept = dict(inspect.signature(made).parameters)
        assert {name: (each.kind, each.default) for name, each in kept.items()} == {
            name: (each.kind, each.default) for name, each in settings.items()
        }
        theirs = typing.get_type_hints(real.__init__)
        ours = typing.get_type_hints(made.__init__)
        assert ours == {name: theirs[name] for name in ours}
    schemas = [OmegaConf.structured(_schema(cls, key[1], True)) for cls in (made, real)]
    assert OmegaConf.to_yaml(schemas[0]) == OmegaConf.to_yaml(schemas[1])


@pytest.mark.parametrize("arguments", [["train", "--help"], ["eval", "--cfg", "job"], ["eval", "solver.gama=1"]])
def test_what_only_composes_imports_nothing_heavy(arguments, tmp_path):
    code = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
sys.argv = ["lp", *{arguments}]
from lp_framework import cli
cli.main()
heavy = {{"torch", "lightning", "torchvision", "matplotlib", "trimesh", "scipy"}} & {{*sys.modules}}
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
