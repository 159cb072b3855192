"""Label files: the labels of a folder's objects, and errors in them."""

import warnings
from pathlib import Path

import pytest

from lp_framework.data.sets.rendered import Label, read_labels
from lp_framework.errors import UserError

NAMES = ["mug", "teapot", "vase"]


@pytest.fixture
def file(tmp_path) -> Path:
    return tmp_path / "labels.yaml"


def read(file: Path, text: str) -> dict[str, Label]:
    file.write_text(text, encoding="utf-8")
    return read_labels(file, NAMES, Path("meshes"))


def test_labels_by_object(file):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        labels = read(
            file,
            "mug: {ambiguity: unique, reason: its handle}\nteapot:\n  ambiguity: twofold\n"
            "vase: {ambiguity: continuous, unique_answer: true, reason: café painted on one side}\n",
        )
    assert {name: (label.ambiguity, label.unique_answer) for name, label in labels.items()} == {
        **{"mug": ("unique", None), "teapot": ("twofold", None), "vase": ("continuous", True)},
    }


def test_numbers_and_yaml_keywords_are_names(file):
    names = ["42", "007", "1.50", "1_000", "2024-01-01", "12:30", "0x10", "yes", "null", "~", "mug"]
    file.write_text("".join(f"{name}: {{ambiguity: unique}}\n" for name in names[:-1]) + '"mug": {ambiguity: twofold}')
    labels = read_labels(file, names, Path("meshes"))
    assert list(labels) == names and [labels[name].ambiguity for name in names] == ["unique"] * 10 + ["twofold"]


def test_objects_that_are_left_out_are_named(file):
    with pytest.warns(UserWarning, match=r"labels\.yaml: has no label for mug, vase$"):
        assert read(file, "teapot: {ambiguity: unique}") == {"teapot": Label(ambiguity="unique")}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mugg: {ambiguity: unique}", r"meshes has no object 'mugg'; did you mean 'mug'\?"),
        ("7: {ambiguity: unique}", r"meshes has no object '7'"),
        ("mug: unique", r"object 'mug': .*, got 'unique'"),
        ("mug: {reason: its handle}", r"object 'mug': ambiguity: Field required"),
        ("mug: {ambiguity: twofolds}", r"object 'mug': ambiguity: Input should be 'unique', 'twofold' or .*'twofolds'"),
        ("mug: {ambiguity: unlabelled}", r"object 'mug': ambiguity: .*, got 'unlabelled'"),
        ("mug: {ambiguity: [unique]}", r"object 'mug': ambiguity: .*, got \['unique'\]"),
        (
            "mug: {ambiguity: unique, unique_answer: maybe}",
            r"object 'mug': unique_answer: .*valid boolean.*, got 'maybe'",
        ),
        ("mug: {ambiguity: unique, unique_answr: true}", r"object 'mug': unique_answr: .*not permitted"),
        ("- mug", r"must give every object its label, as in 'mug: \{ambiguity: unique\}'"),
        ("", r"must give every object its label"),
        ("mug: {ambiguity: unique", r"is not readable YAML \("),
        ("mug: \0", r"is not readable YAML \("),
        ("? [mug]\n: {ambiguity: unique}", r"is not readable YAML \("),
        ("mug: {}\n---\nvase: {}", r"is not readable YAML \("),
    ],
)
def test_bad_files(file, text, message):
    with pytest.raises(UserError, match=message) as caught:
        read(file, text)
    assert str(caught.value).startswith(str(file)) and "\n" not in str(caught.value)


def test_files_that_cannot_be_read(file, tmp_path):
    with pytest.raises(UserError, match=r"labels\.yaml: there is no such file"):
        read_labels(file, NAMES, Path("meshes"))
    with pytest.raises(UserError, match="is not readable YAML"):
        read_labels(tmp_path, NAMES, Path("meshes"))
    file.write_bytes(b"mug: \xff")
    with pytest.raises(UserError, match="is not readable YAML"):
        read_labels(file, NAMES, Path("meshes"))
