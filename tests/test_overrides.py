"""Paths on the command line reach the configuration unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from lp_framework.errors import UserError
from lp_framework.overrides import quote_paths


def read(command: str, *overrides: str) -> dict[str, object]:
    """What Hydra makes of a command line."""
    parsed = OverridesParser.create().parse_overrides(quote_paths(command, overrides))
    return {each.key_or_group: each.value() for each in parsed}


@pytest.mark.parametrize(
    "path",
    [
        *("20240101", "2024_01_01", "1e5", "-3", "0.5", ".5", "nan", "inf", "true", "No"),
        *("fotos_grün", "IMG (1).png", "bob's", "a\\b\\", "C:\\x y\\'z", "epoch=3-step=10.ckpt", "x#1", "a&b", "{x}"),
        *("a[1", "位姿", "tab\there", "runs/score", "photo(1)", "a'b", 'say "hi"', "50%", "a!b", "a;b", ".", ".."),
    ],
)
@pytest.mark.parametrize("key", ["images", "checkpoint", "data.path", "prior.path", "resume", "hydra.run.dir", "runs"])
def test_a_path_is_the_text_that_was_typed(key, path):
    assert read("eval", f"{key}={path}") == {key: path}


def test_lists_functions_interpolations_and_quotes():
    assert read("estimate", "images=[IMG (1).png, b.png]") == {"images": ["IMG (1).png", "b.png"]}
    assert read("estimate", "images=['a, b.png','c.png']") == {"images": ["a, b.png", "c.png"]}
    assert read("eval", "hydra.run.dir=runs/${seed}") == {"hydra.run.dir": "runs/${seed}"}
    assert read("estimate", "images=null", "images='x y'") == {"images": "x y"}
    assert read("eval", "data.path=~/views") == {"data.path": str(Path.home() / "views")}
    assert read("eval", "plugins=/a/b", "seed=20240101") == {"plugins": ["/a/b"], "seed": 20240101}
    assert read("eval", "data.objects=[42, IMG (1),mug]") == {"data.objects": ["42", "IMG (1)", "mug"]}
    assert read("eval", "data.objects=500") == {"data.objects": 500}  # of procedural objects their number
    assert quote_paths("eval", ["checkpoint=runs/a,20240101"]) == ["checkpoint=runs/a,'20240101'"]
    assert quote_paths("eval", ["checkpoint=choice(a,b)"]) == ["checkpoint=choice(a,b)"]


def test_images_of_estimate_need_no_key():
    assert read("estimate", "IMG (1).png", "seed=1", "b.png") == {"images": ["IMG (1).png", "b.png"], "seed": 1}
    assert read("estimate", "20240101") == {"images": "20240101"}
    with pytest.raises(UserError, match=r"give the images either as images=\.\.\. or as arguments without a key"):
        quote_paths("estimate", ["a.png", "images=b"])
    assert quote_paths("eval", ["a.png"]) == ["a.png"]
