"""The page of a run: self-contained and complete, and interactive in a browser, if installed."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exact_prior import ExactPrior, image_of
from in_browser import PATIENCE, chromium, with_browser
from page_runs import NASTY, STEPS, WRITERS, example, torch_equal, write_evaluation, write_training
from PIL import Image

from lp_framework.analysis import examples as examples_module
from lp_framework.analysis.examples import (
    EXAMPLES,
    FILE,
    MOST,
    gather_examples,
    pick_examples,
    read_examples,
    save_examples,
)
from lp_framework.analysis.pairs import recording
from lp_framework.data.pairs import PairBatch, PairData, ViewTable
from lp_framework.data.views import ObjectViews
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.geometry import camera_to_world, wrap_angle
from lp_framework.models.pose_model import FieldValue
from lp_framework.report import page as page_module
from lp_framework.report.page import write_report_page, write_run_page
from lp_framework.report.runs import run_folders, run_kind
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage
from lp_framework.viz import style

LARGEST = 10_000_000  # bytes
VOID = {"meta", "link", "img", "input", "wbr"}
DEEP, DEEP_YAML = "[" * 100_000, "a: " + "[" * 3000  # deeper than their readers go


class Page(HTMLParser):
    """Parses a page into elements and checks that they are closed in order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text = path.read_text(encoding="utf-8")
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.headings: list[str] = []
        self.figures: dict[str, list[Any]] = {}  # by kind
        self.feed(self.text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if packed := dict(attrs).get("data-figure"):
            kind = str(dict(attrs)["class"]).removeprefix("plot ")
            self.figures.setdefault(kind, []).append(json.loads(gzip.decompress(base64.b64decode(packed))))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words.append(data)
            if self.open[-1] == "h2":
                self.headings.append(data)

    @property
    def visible(self) -> str:
        """The visible text, in one line."""
        return " ".join(" ".join(self.words).split())


def page_of(folder: Path) -> Page:
    kind = run_kind(folder)
    assert kind is not None
    path = write_run_page(folder, kind)
    assert path == folder / "report.html"
    return Page(path)


# ---------------------------------------------------------------- examples on disk


def test_examples_round_trip(tmp_path):
    saved = example(NASTY, 170.0)
    query = dataclasses.replace(saved.query, field_of_view=0.5)
    saved = dataclasses.replace(saved, query=query)
    save_examples(tmp_path / "a", [example(), saved])
    _, read = read_examples(tmp_path / "a")
    assert (read.object, read.ambiguity, read.reason, read.chosen) == (NASTY, "unique", saved.reason, 1)
    assert read.failed and not example().failed
    for name in ("truth", "starts", "trajectories", "ends", "energies", "rotation_errors", "translation_errors"):
        np.testing.assert_allclose(getattr(read, name), getattr(saved, name), rtol=1e-5, atol=1e-9)
    assert np.array_equal(read.query.image, saved.query.image) and read.query.file.name == "001.png"
    assert read.query.field_of_view == 0.5 and read.reference.field_of_view == math.radians(49.1)
    assert read.landscapes.keys() == saved.landscapes.keys()
    assert all(torch_equal(read.landscapes[name], saved.landscapes[name]) for name in saved.landscapes)


def test_saving_replaces_the_examples_of_an_earlier_run(tmp_path):
    save_examples(tmp_path / "a", [example(), example()])
    save_examples(tmp_path / "a", [example()])
    assert {file.name for file in (tmp_path / "a").iterdir()} == {FILE, "0_reference.png", "0_query.png"}


# ---------------------------------------------------------------- examples of an evaluation


class Reader(torch.nn.Module):
    """A score model that reads the pose off the image as `ExactPrior` does."""

    has_energy, has_density, sigma, choose_by = False, False, 1.0, "distance"

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        return images.flatten(1)[:, :3]

    def condition(self, reference: torch.Tensor, query: torch.Tensor) -> torch.Tensor:
        return query - reference

    def field(self, condition: torch.Tensor, pose: torch.Tensor) -> FieldValue:
        offset = condition - pose
        return FieldValue(torch.stack([offset[..., 0], wrap_angle(offset[..., 1]), offset[..., 2]], dim=-1), None)

    def probability(self, condition: torch.Tensor, pose: torch.Tensor) -> None:
        return None


class WithPoses(PairBatch):
    """Images that say their poses; pixels would round them."""

    @property
    def images(self):
        return image_of(self.poses.float())


class Exact(PairData):
    """Views whose images say their poses."""

    def __getitem__(self, pairs):
        return WithPoses(**vars(super().__getitem__(pairs)))


@pytest.fixture
def evaluation() -> tuple[Evaluation, PairData]:
    generator = torch.Generator().manual_seed(3)
    objects = []
    for name, unique in [(f"cup_{number}", True) for number in range(7)] + [("vase", False)]:
        unit = torch.rand(3, 3, generator=generator, dtype=torch.float64)
        poses = torch.tensor([-0.2, 0.5, 1.3]) + unit * torch.tensor([0.4, 4.0, 0.4])
        files = [Path(f"{view:03d}.png") for view in range(3)]
        kind = "unique" if unique else "continuous"
        objects.append(ObjectViews(name, "test", kind, unique, files, camera_to_world(poses), torch.full((3,), 0.857)))
    data = Exact(ViewTable(objects), np.zeros((24, 8, 8, 3), dtype=np.uint8), None)
    solver = TwoStage(Reader(), ExactPrior((0.0, torch.pi), (0.0, 0.3)), gamma=0.0, iterations=12, refinement_steps=8)  # type: ignore[arg-type]
    evaluation = Evaluation(solver, Ring(3), seed=0)
    evaluation.reset_metrics(data.table)
    with torch.no_grad():
        evaluation.test_step(data[data.table.pairs()], 0)
    evaluation.metrics.compute()
    return evaluation, data


def test_examples_have_the_evaluations_answers_with_their_trajectories(evaluation):
    evaluation, data = evaluation
    examples = gather_examples(evaluation, data)
    rows = evaluation.metrics.rows()
    errors = rows["rotation"].gather(1, rows["chosen"][:, None])[:, 0]
    assert len(examples) == MOST and len({each.object for each in examples}) >= 3
    shown = [each.rotation_errors[each.chosen] for each in examples]
    assert shown == sorted(shown, reverse=True) and shown[0] == pytest.approx(errors.max().item())
    for each in examples:
        index = evaluation.table.names.index(each.object)
        same = (rows["object"] == index) & (errors == each.rotation_errors[each.chosen])
        assert any(np.allclose(each.ends[each.chosen], row, atol=1e-4) for row in rows["answer"][same].numpy())
        assert each.trajectories is not None and each.trajectories.shape == (3, 12 + 8 + 1, 3)  # of both stages
        np.testing.assert_allclose(each.trajectories[:, 0, 1] % (2 * np.pi), each.starts[:, 1] % (2 * np.pi), atol=1e-5)
        np.testing.assert_allclose(np.sin(each.trajectories[:, -1]), np.sin(each.ends), atol=1e-4)
        relative = each.query.pose - each.reference.pose
        np.testing.assert_allclose(np.sin(each.truth), np.sin(relative), atol=1e-5)


def test_the_priors_landscape_is_deepest_at_the_truth(evaluation):
    evaluation, data = evaluation
    for each in gather_examples(evaluation, data):
        deepest = each.landscapes["energy of the prior"].minima()[0]
        assert abs(deepest.latitude - each.truth[0]) < 0.1
        assert abs(wrap_angle(torch.tensor(deepest.longitude - each.truth[1]))) < 0.15


def test_a_prior_that_would_take_long_has_no_landscape(evaluation, monkeypatch):
    evaluation, data = evaluation
    monkeypatch.setattr(examples_module, "SECONDS", 0.0)
    monkeypatch.setattr(examples_module, "SHARE", 0.0)
    assert all("energy of the prior" not in each.landscapes for each in gather_examples(evaluation, data))


def test_the_solver_is_unchanged(evaluation):
    solver = evaluation[0].solver
    recorded = recording(solver)
    assert recorded.first.trajectory and recorded.second.trajectory
    assert not solver.first.trajectory and not solver.second.trajectory and recorded.prior is solver.prior


def test_other_objects_add_their_worst_pairs_those_with_a_unique_answer_first():
    errors = np.array([90.0, 1.0, 5.0, 7.0, 70.0, 60.0, 2.0, 3.0, 8.0, 4.0])
    objects = np.array([0, 0, 0, 0, 2, 3, 4, 4, 4, 5])
    unique = [True, True, False, False, True, True]
    reasons = pick_examples(errors, objects, ["a", "none", "c", "d", "e_f", "g"], unique)
    assert list(reasons) == sorted(reasons, key=lambda row: -errors[row]) and len(reasons) == MOST
    assert (
        reasons[0] == "worst of 8 pairs with a unique answer" and reasons[1] == "best of 8 pairs with a unique answer"
    )
    assert reasons[8] == "worst of 3 pairs of e f"  # before the worst of `c`, which has no unique answer


# ---------------------------------------------------------------- pages as files


@pytest.mark.parametrize("kind", WRITERS)
def test_a_page_is_self_contained(kind, tmp_path):
    folder = WRITERS[kind](tmp_path / "run")
    page = page_of(folder)
    assert (folder / "report.html").stat().st_size < LARGEST
    assert not list(folder.glob(".*.partial"))
    for tag, attributes in page.elements:
        assert tag not in ("iframe", "object", "embed", "base")
        for name in ("src", "href", "srcset", "action", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value[:60])
        assert not any(name.startswith("on") for name in attributes)
    style_text = page.text.partition("<style>")[2].partition("</style>")[0]
    assert "url(" not in style_text and "@import" not in style_text
    policy = next(each["content"] for tag, each in page.elements if each.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy and "http" not in policy
    assert "Not shown" not in page.visible
    assert any("width=device-width" in (each.get("content") or "") for _, each in page.elements)


def test_names_cannot_break_out(tmp_path):
    page = page_of(write_evaluation(tmp_path / NASTY.replace("/", "")))
    assert not any(attributes.get("onerror") for _, attributes in page.elements)
    assert not any(tag == "img" and not attributes["src"].startswith("data:") for tag, attributes in page.elements)
    shown = NASTY.replace("_", " ")
    assert page.visible.count(shown) >= 3  # a card, a row an object, rows of the worst pairs
    assert cards(page) == [shown, "vase", "red mug"]  # failures first


def cards(page: Page) -> list[str]:
    """The objects of the pairs on a page."""
    alts = [str(attributes["alt"]) for tag, attributes in page.elements if tag == "img"]
    return [alt.removeprefix("query of ").rpartition(":")[0] for alt in alts if alt.startswith("query of ")]


def test_the_data_of_a_page_are_those_of_the_run(tmp_path):
    page = page_of(write_evaluation(tmp_path / "run"))
    expected = example()
    energy = expected.landscapes["energy of the prior"].energy.numpy()
    contours = [trace for trace in page.figures["map"][-1]["data"] if trace["type"] == "contour"]
    assert [trace["meta"] for trace in contours] == list(expected.landscapes)
    assert [trace["visible"] for trace in contours] == [True, False]
    np.testing.assert_allclose(np.array(contours[0]["z"])[:, :-1], energy, atol=1e-4)
    minima = expected.landscapes["energy of the prior"].minima()
    assert len(minima) == 2 and "energy of the prior 2 minima, deepest first: " in page.visible.replace("\n", " ")
    curves = [trace for trace in page.figures["errors"][0]["data"] if trace["mode"] == "lines"]
    assert [curve["name"] for curve in curves] == [f"{kind} (4 pairs)" for kind in ("unique", "twofold", "continuous")]
    assert curves[0]["y"][-1] == 0.75  # one of four pairs has no answer
    assert "R@5, unique answer" in page.visible and "Configuration" in page.visible and "torch" in page.visible


def test_the_marks_of_a_pair_are_at_its_poses_in_every_frame(tmp_path):
    page = page_of(write_evaluation(tmp_path / "run"))
    expected = example()
    path = expected.trajectories[expected.chosen]
    degrees = np.degrees(path[:, [1, 0]])
    for kind in ("map", "surface"):
        figure = page.figures[kind][-1]
        meta = figure["layout"]["meta"]
        answers = [points for trace, points in zip(meta["traces"], zip(*meta["frames"], strict=True), strict=True)
                   if figure["data"][trace]["marker"]["symbol"] == "diamond"]  # fmt: skip
        assert len(answers) == (1 if kind == "map" else 2) and len(meta["frames"]) == STEPS + 1
        for points in answers:
            np.testing.assert_allclose([[*each["x"], *each["y"]] for each in points], degrees, atol=0.01)
    heights = np.array([each["z"] for each in answers[0]])  # of the energy, a little above it
    energy = expected.landscapes["energy of the prior"].energy.numpy()
    assert energy.min() < heights.min() and heights.max() < energy.max() + 0.04 * np.ptp(energy)
    figure = page.figures["cameras"][-1]
    number = figure["layout"]["meta"]["traces"].index(len(figure["data"]) - 2)
    frames = [frame[number] for frame in figure["layout"]["meta"]["frames"]]
    poses = torch.from_numpy(expected.reference.pose + path)
    x, y, z = camera_to_world(poses)[:, :3, 3].numpy().T
    found = [[*each["x"], *each["y"], *each["z"]] for each in frames]
    np.testing.assert_allclose(found, np.stack([x, -z, y]).T, atol=1e-3)


def test_a_long_trajectory_has_few_frames_including_its_last_step(tmp_path):
    folder = write_evaluation(tmp_path / "run")
    save_examples(folder / "pictures" / EXAMPLES, [example(steps=500)])
    page = page_of(folder)
    for kind in ("map", "surface", "cameras"):
        (figure,) = page.figures[kind]
        assert len(figure["layout"]["meta"]["frames"]) == 40
    assert "step 500 of 500" in page.visible


@pytest.mark.parametrize(
    ("kind", "file", "content"),
    [
        ("eval", "pairs.csv", None),
        ("eval", "pairs.csv", "object\na\n"),
        ("eval", "pictures/examples/examples.json", None),
        ("eval", "pictures/examples/0_query.png", "no image"),
        ("eval", "pictures/examples/examples.json", '{"examples": [{"object": "a"}]}'),
        ("eval", "results.json", '{"metrics": 3}'),
        ("eval", "results.json", "{"),
        ("eval", "results.json", DEEP),
        ("eval", "pictures/examples/examples.json", DEEP),
        ("train", "metrics.csv", None),
        ("train", "metrics.csv", "step,train/loss\nx,y\n"),
        ("train", "training.json", "[]"),
        ("train", "config.yaml", "a: ["),
        ("train", "config.yaml", DEEP_YAML),
        ("estimate", "poses.csv", "file,image\na,b\n"),
        ("estimate", "images/000.png", None),
        ("estimate", "results.json", None),
        ("landscape", "azimuth.json", "{}"),
        ("landscape", "azimuth.json", DEEP),
        ("pair", "pictures/examples/examples.json", "7"),
        ("pair", "landscape.png", None),
    ],
    ids=lambda each: str(each)[:40],
)
def test_a_note_replaces_what_is_missing_or_damaged(kind, file, content, tmp_path):
    folder = WRITERS[kind](tmp_path / "run")
    if kind == "eval":  # one pair is enough
        save_examples(folder / "pictures" / EXAMPLES, [example()])
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    page = page_of(folder)
    assert re.search("Not shown: .*\\.|unfinished|no results|missing", page.visible)
    assert "Configuration and versions" in page.visible


def test_a_run_without_pictures_has_its_tables(tmp_path):
    folder = write_evaluation(tmp_path / "run")
    shutil.rmtree(folder / "pictures")
    page = page_of(folder)
    assert "Not shown: the run has no pictures (pictures=false)." in page.visible
    assert "R@5, unique answer" in page.visible and "The 12 worst pairs" in page.visible


def test_the_colours_are_those_of_the_figures():
    text = (Path(page_module.__file__).parent / "templates" / "page.css").read_text()
    light = text.partition("@media")[0]
    named = {"truth": style.TRUTH, "answer": style.ANSWER, "others": style.OTHERS, **style.CLASS_COLOURS}
    for name, colour in named.items():
        assert re.search(rf"--{name}: {colour};", light, re.IGNORECASE), name


# ---------------------------------------------------------------- pages of several runs


def test_runs_are_known_by_their_command_or_by_their_files(tmp_path):
    for kind, write in WRITERS.items():
        write(tmp_path / kind)
    (tmp_path / "other" / ".hydra").mkdir(parents=True)
    kinds = {"eval": "eval", "train": "train", "estimate": "estimate", "landscape": "landscape", "pair": "landscape"}
    assert {folder.name: kind for folder, kind in run_folders([tmp_path, tmp_path / "eval"])} == kinds
    for kind in WRITERS:
        shutil.rmtree(tmp_path / kind / ".hydra")
    assert {folder.name: kind for folder, kind in run_folders([tmp_path])} == kinds


def test_a_page_of_several_runs_has_a_section_for_each(tmp_path):
    runs = [(write_evaluation(tmp_path / f"e{seed}", seed), "eval") for seed in range(2)]
    runs.append((write_training(tmp_path / "t"), "train"))
    page = Page(write_report_page(tmp_path / "report.html", runs, {}))
    opened = {each["id"] for _, each in page.elements if (each.get("id") or "").startswith("run-")}
    links = {each["href"].removeprefix("#") for tag, each in page.elements if tag == "a"}
    assert opened == links and len(opened) == 3


def test_runs_that_would_make_the_page_too_large_are_only_in_the_table(tmp_path, monkeypatch):
    runs = [(write_evaluation(tmp_path / f"e{seed}", seed), "eval") for seed in range(3)]
    sizes = [len(Page(write_report_page(tmp_path / "one.html", runs[:1], {})).text)]
    monkeypatch.setattr(page_module, "LARGEST", sizes[0] - 2_000_000)  # without plotly.js: room for one
    page = Page(write_report_page(tmp_path / "report.html", runs, {}))
    left_out = 3 - sum(tag == "details" and each.get("class") == "run" for tag, each in page.elements)
    assert left_out >= 1 and f"{left_out} runs are only in the table" in page.visible
    assert all(str(folder) in page.visible for folder, _ in runs)


@pytest.mark.parametrize("kind", WRITERS)
def test_report_writes_the_page_of_a_single_run_of_any_command(kind, lp, tmp_path):
    WRITERS[kind](tmp_path / "run")
    ran = lp("report", "runs=run", "hydra.run.dir=out")
    assert ran.status == 0, ran.err
    assert "page:    out/report.html" in ran.out and "left out" not in ran.out
    page = Page(tmp_path / "out" / "report.html")
    assert page.headings[-1] == "Configuration and versions"
    assert (tmp_path / "out" / "report.md").is_file() == (kind == "eval")


def test_report_of_runs_of_several_commands(lp, tmp_path):
    for kind, write in WRITERS.items():
        write(tmp_path / "runs" / kind)
    ran = lp("report", "runs=runs", "objects=all", "hydra.run.dir=out")
    assert ran.status == 0, ran.err
    assert ran.out.startswith("5 runs; metrics over all objects")
    visible = Page(tmp_path / "out" / "report.html").visible
    assert all(name in visible for name in ("Evaluations", "Training runs", "Estimates", "Landscapes"))


# ---------------------------------------------------------------- in a browser

DRAWN = """(place) => {
    const plot = document.querySelectorAll('.plot')[place];
    return plot.classList.contains('drawn') || !plot.checkVisibility();
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    """`opened(path, scheme, width)`: the page in a browser; afterwards it must have had neither errors nor requests."""
    contexts, wrong = [], []

    def open_page(path: Path, scheme: str = "light", width: int = 1200) -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.append(request.url) if not request.url.startswith(KNOWN) else None)
        address = path.resolve().as_uri()
        KNOWN = (address, "data:", "blob:")
        page.goto(address)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.fixture(scope="module")
def evaluation_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of an evaluation."""
    return write_run_page(write_evaluation(tmp_path_factory.mktemp("evaluation") / "run"), "eval")


@pytest.fixture(scope="module")
def tables_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without pictures, which take long to draw."""
    folder = write_evaluation(tmp_path_factory.mktemp("tables") / "run")
    shutil.rmtree(folder / "pictures")
    return write_run_page(folder, "eval")


def scroll_through(page: Any) -> None:
    """Down the page, so that every plot in sight is drawn."""
    for place in range(page.locator(".plot").count()):
        page.evaluate("(place) => document.querySelectorAll('.plot')[place].scrollIntoView()", place)
        page.wait_for_function(DRAWN, arg=place)


def colours(page: Any, selector: str) -> int:
    """How many colours there are where an element is on the screen."""
    shot = Image.open(BytesIO(page.locator(selector).first.screenshot())).convert("RGB")
    return len(shot.getcolors(shot.width * shot.height))


@with_browser
@pytest.mark.parametrize(("scheme", "width"), [("light", 1200), ("dark", 1200), ("dark", 390)])
def test_a_page_is_drawn_in_light_and_dark_on_desks_and_phones(scheme, width, opened, evaluation_page):
    page = opened(evaluation_page, scheme, width)
    timing = page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd")
    assert timing < 20_000  # milliseconds; under three seconds on a machine that does nothing else
    scroll_through(page)
    for kind in ("map", "surface", "cameras", "errors"):
        assert colours(page, f".plot.{kind}") > 100, kind
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    red, green, blue = map(
        int, re.findall(r"\d+", page.evaluate("getComputedStyle(document.body).backgroundColor"))[:3]
    )
    assert (min(red, green, blue) > 200) if scheme == "light" else (max(red, green, blue) < 60)
    font = page.evaluate("document.querySelector('.plot.map').layout.font.color")
    assert font == ("#222222" if scheme == "light" else "#e9e9e6")


@with_browser
@pytest.mark.parametrize(("width", "whole"), [(1280, True), (390, False)])
def test_a_table_shows_all_of_its_columns_or_scrolls_in_its_own_box(width, whole, opened, tables_page):
    page = opened(tables_page, "light", width)
    for name in ("summary", "objects"):
        region = page.get_by_role("region", name=name)
        assert region.evaluate("(box) => box.scrollWidth <= box.clientWidth") == whole
        region.evaluate("(box) => { box.scrollLeft = box.scrollWidth; }")
        last = region.locator("thead th").last
        right, edge = (each.evaluate("(each) => each.getBoundingClientRect().right") for each in (last, region))
        assert right <= edge + 1 <= width + 1


@with_browser
@pytest.mark.parametrize("kind", ["train", "estimate", "landscape"])
def test_pages_of_the_other_commands_are_drawn(kind, opened, tmp_path):
    folder = WRITERS[kind](tmp_path / "run")
    page = opened(write_run_page(folder, run_kind(folder)), "dark", 390)
    scroll_through(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for selector in (".plot:visible", ".sparkline")[: 1 if kind != "landscape" else 2]:
        if page.locator(selector).count():
            assert colours(page, selector) > 10


@with_browser
def test_plots_follow_the_system_from_light_to_dark(opened, tmp_path):
    page = opened(write_run_page(write_training(tmp_path / "run"), "train"))
    scroll_through(page)
    assert page.evaluate("document.querySelector('.plot').layout.font.color") == "#222222"
    page.emulate_media(color_scheme="dark")
    page.wait_for_function("document.querySelector('.plot').layout.font.color === '#e9e9e6'")


MARKS = """[...document.querySelectorAll('.stage:not([hidden]) .plot')].map((plot) =>
    plot.layout.meta.traces.map((trace) => plot.data[trace]).map(({ x, y, z }) => [x, y, z]))"""
FRAME = """(step) => [...document.querySelectorAll('.stage:not([hidden]) .plot')].map((plot) =>
    plot.layout.meta.frames[step].map(({ x, y, z }) => [x, y, z]))"""


@with_browser
def test_the_slider_plays_the_trajectories_of_the_pair_that_is_chosen(opened, evaluation_page):
    page = opened(evaluation_page, "light", 600)
    scroll_through(page)
    slider = page.get_by_label("solver step").first
    assert slider.input_value() == slider.get_attribute("max") == str(STEPS)
    at_the_end = page.evaluate(MARKS)
    assert at_the_end == page.evaluate(FRAME, STEPS)
    slider.fill("3")
    assert page.evaluate(MARKS) == page.evaluate(FRAME, 3) != at_the_end
    slider.press("ArrowRight")
    assert slider.input_value() == "4" and "step 4 of 20" in page.locator(".player output").first.inner_text()
    assert page.evaluate(MARKS) == page.evaluate(FRAME, 4)
    play = page.locator(".player button").first
    play.evaluate("(button) => { button.click(); button.click(); }")
    assert play.inner_text() == "Play" and slider.input_value() == "4"  # it has stopped where it was
    slider.fill(str(STEPS - 4))
    play.click()
    page.wait_for_function(f"document.querySelector('.player input').value === '{STEPS}'")
    page.wait_for_function("document.querySelector('.player button').textContent === 'Play'")
    assert page.evaluate(MARKS) == at_the_end

    cards = page.locator(".card")
    assert cards.count() == 3 and cards.first.get_attribute("aria-pressed") == "true"
    assert "off by 170.0°" in page.locator(".pair-facts:visible").inner_text()
    cards.nth(2).press("Enter")
    assert "off by 3.0°" in page.locator(".pair-facts:visible").inner_text()
    assert cards.nth(2).get_attribute("aria-pressed") == "true"
    scroll_through(page)
    assert page.locator(".plot.surface.drawn").count() == 1  # the one of the first pair has been removed
    shown = "document.querySelector('.stage:not([hidden]) .plot.surface')._fullData.filter((trace) => trace.visible)"
    assert page.evaluate(f"new Set({shown}.map((trace) => trace.meta)).size") == 1
    page.locator("select:visible").select_option("length of the model's score")
    assert page.evaluate(f"{shown}[0].meta") == "length of the model's score"
    cards.nth(0).click()
    scroll_through(page)
    assert colours(page, ".plot.surface") > 100


@with_browser
def test_a_table_sorts_by_click_and_by_keyboard(opened, tables_page):
    page = opened(tables_page)
    table = page.get_by_role("region", name="objects").locator("table")

    def names() -> list[str]:
        return table.locator("tbody th").all_inner_texts()

    nasty = NASTY.replace("_", " ")
    assert names() == [nasty, "vase", "red mug"]  # worst recall first
    recall = table.get_by_role("button", name="R@15", exact=True)
    head = table.locator("th", has=page.get_by_role("button", name="R@15", exact=True))
    recall.click()
    assert names() == ["red mug", "vase", nasty] and head.get_attribute("aria-sort") == "descending"
    recall.press("Enter")
    assert names() == [nasty, "vase", "red mug"] and head.get_attribute("aria-sort") == "ascending"
    table.get_by_role("button", name="object", exact=True).press("Space")
    assert names()[-2:] == ["red mug", "vase"] and head.get_attribute("aria-sort") == "none"
    head_top = table.locator("thead").bounding_box()["y"]
    page.get_by_role("region", name="objects").evaluate(
        "(region) => { region.style.maxHeight = '90px'; region.scrollTop = 60 }"
    )
    assert table.locator("thead th").first.bounding_box()["y"] == pytest.approx(head_top, abs=2)


@with_browser
def test_a_run_of_a_set_opens_from_the_table(opened, tmp_path):
    runs = [(write_evaluation(tmp_path / f"e{seed}", seed), "eval") for seed in range(2)]
    page = opened(write_report_page(tmp_path / "report.html", runs, {}), "light", 390)
    assert not page.locator(".card").first.is_visible()
    page.locator("a[href='#run-1']").click()
    page.locator("details[open] .card").first.wait_for(state="visible")
    scroll_through(page)
    assert colours(page, "details[open] .plot.map") > 100
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
