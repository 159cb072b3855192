"""The web app: its requests one by one, its visitors' files, what it computes, and all of it in a browser."""

from __future__ import annotations

import csv
import io
import math
import re
import threading
import time
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from in_browser import PATIENCE, chromium, with_browser
from PIL import Image
from view_folders import draw_view, random_poses, write_split

from lp_framework.analysis.confidence import Answer, in_words
from lp_framework.analysis.fields import Draws
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.analysis.pairs import PRIOR_ENERGY, ShownPair, View
from lp_framework.api import TINY_WARNING
from lp_framework.data.module import PairDataModule
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError
from lp_framework.report.plots import map_plot
from lp_framework.solvers.progress import steps_of

pytest.importorskip("dash")

from lp_framework.app import forms
from lp_framework.app.estimate import own_names, second_minimum, warnings_of
from lp_framework.app.explore import end_of
from lp_framework.app.jobs import Cancelled, Jobs
from lp_framework.app.server import make_app
from lp_framework.app.visitors import Visitors
from lp_framework.app.workbench import Choice, Request, Workbench

GENERAL = Request(Choice("sharp"), Choice("modes"), Choice("tiny"), "general")
PAPER = Request(Choice("two_stage", {"iterations": 3, "refinement_steps": 3}), Choice("ring"), Choice("tiny"), "score")


# ---------------------------------------------------------------- requests


@pytest.fixture
def jobs() -> Iterator[Jobs]:
    made = Jobs()
    yield made
    made.close()


def wait_for(jobs: Jobs, name: str) -> None:
    until = time.monotonic() + 20
    while not jobs.is_done(name) and time.monotonic() < until:
        time.sleep(0.01)


def test_requests_run_in_turn_and_tell_how_far_they_are(jobs: Jobs) -> None:
    step, reached = threading.Event(), threading.Event()

    def work() -> int:
        for number in steps_of(4, "second stage"):
            if number == 1:
                reached.set()
                step.wait(20)
        return 7

    first, second = jobs.submit(work), jobs.submit(lambda: 8)
    assert reached.wait(20)
    assert jobs.state(first) == (0.25, "second stage 2 of 4")
    assert jobs.state(second) == (0.0, "1 request before this one")
    step.set()
    assert (jobs.result(first), jobs.result(second)) == (7, 8)
    assert jobs.is_done(first)


def test_a_cancelled_request_ends_at_its_next_step_and_the_next_one_runs(jobs: Jobs) -> None:
    begun, go_on = threading.Event(), threading.Event()
    done = []

    def work() -> None:
        for number in steps_of(5, "steps"):
            begun.set()
            go_on.wait(20)
            done.append(number)

    running, waiting, last = jobs.submit(work), jobs.submit(lambda: 1), jobs.submit(lambda: 2)
    assert begun.wait(20)
    jobs.cancel(running)
    jobs.cancel(waiting)
    go_on.set()
    for name in (running, waiting):
        with pytest.raises(Cancelled):
            jobs.result(name)
    assert jobs.result(last) == 2
    assert done == [0]


def test_what_goes_wrong_is_one_sentence_and_warnings_stay_with_their_request(jobs: Jobs) -> None:
    def warns() -> None:
        import logging

        logging.getLogger("lp_framework.test").warning("the border cuts the object off")

    def breaks() -> None:
        raise KeyError("x")

    name, other = jobs.submit(warns), jobs.submit(lambda: None)
    jobs.result(other)
    assert (jobs.warnings(name), jobs.warnings(other)) == (["the border cuts the object off"], [])
    with pytest.raises(UserError, match="something went wrong"):
        jobs.now(breaks)
    with pytest.raises(UserError, match="no longer has the answer to this request"):
        jobs.result("unknown")


def test_answers_that_are_looked_at_stay(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lp_framework.app.jobs.KEPT", 2)
    scene, left = jobs.submit(lambda: "scene"), jobs.submit(lambda: "left")
    for _ in range(5):
        jobs.now(lambda: None)
        assert jobs.result(scene) == "scene"
    with pytest.raises(UserError):
        jobs.result(left)


# ---------------------------------------------------------------- files of visitors


def test_uploads_stay_in_the_visitors_folder_and_go_with_the_app() -> None:
    visitors = Visitors()
    one, other = visitors["one"], visitors["other"]
    one.take_photographs([("../../evil.png", b"1"), ("C:\\photos\\b.png", b"2"), ("..", b"3")])
    assert [file.name for file in one.files] == ["b.png", "evil.png", "image"]
    assert all(file.is_relative_to(one.folder) and not file.is_relative_to(other.folder) for file in one.files)
    other.take_masks([("2.png", b"3")])
    other.take_photographs([("10.png", b"1"), ("2.png", b"2")])
    assert other.masks is not None  # uploaded before the first photographs
    other.take_photographs([("10.png", b"1"), ("2.png", b"2")])
    assert other.masks is None  # of other photographs
    assert [file.name for file in other.files] == ["2.png", "10.png"]
    assert visitors["one"] is one
    text = f"{one.files[0]}: is not a readable image"
    assert own_names(text, one.folder) == "b.png: is not a readable image"
    visitors.close()
    assert not one.folder.exists()


def test_photographs_of_a_visitor_who_left_are_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    visitors = Visitors()
    left = visitors["left"]
    left.take_photographs([("a.png", b"1")])
    monkeypatch.setattr("lp_framework.app.visitors.KEPT_SECONDS", -1.0)
    visitors["new"]
    assert not left.folder.exists()
    assert visitors["left"].files == []
    visitors.close()


# ---------------------------------------------------------------- settings


def test_settings_have_the_values_and_comments_of_their_yaml() -> None:
    rows = forms.settings_of("estimate", "solver", "two_stage")
    told = {row.children[0].children: (row.children[1].value, row.children[2].children) for row in rows}
    assert told["gamma"][0] == "[0.0, 0.3, 0.0]"
    assert told["patience"] == ("10", "patience of the plateau schedule, steps")
    assert not {"name", "trajectory"} & set(told)


def test_only_changed_settings_are_passed_on() -> None:
    def states(**values: str) -> list[dict[str, Any]]:
        return [{"id": {"setting": key}, "value": value} for key, value in values.items()]

    own = states(alpha="0.1", gamma="[0.0, 0.3, 0.0]", iterations="20", choose_by="null")
    assert forms.chosen("solver", "langevin", own) == Choice("langevin", {"iterations": 20})
    assert forms.chosen("solver", "langevin", states(sigma="[1.0, 0.2]")).settings == {"sigma": [1.0, 0.2]}
    assert forms.chosen("solver", "langevin", states(alpha="1e-3")).settings == {"alpha": 0.001}
    with pytest.raises(UserError, match=r"solver, alpha: '\[1' is not a number"):
        forms.chosen("solver", "langevin", states(alpha="[1"))


# ---------------------------------------------------------------- what is computed


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three objects with four test views each."""
    root = tmp_path_factory.mktemp("app") / "views"
    for name in ("cup", "tram", "vase"):
        write_split(root / name / "test", random_poses(4, name), size=128, ambiguity="unique")
    return root


@pytest.fixture(scope="module")
def bench(objects: Path) -> Workbench:
    data = PairDataModule(RenderingsData(str(objects)), cache=str(objects.parent / "cache"))
    data.evaluate_on("ordered", 0)
    draws = Draws([500], noises=1, seed=0)
    first = torch.tensor([0.0, 0.0, 1.4], dtype=torch.float64)
    return Workbench(torch.device("cpu"), data, Choice("tiny"), draws, first, seed=0)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("photographs")
    files = [folder / name for name in ("a.png", "b.png", "c.png")]
    for file, pose in zip(files, random_poses(3, "photographs"), strict=True):
        Image.fromarray(draw_view(pose, 128)).save(file)
    return files


def test_photographs_get_the_answers_of_the_command(
    bench: Workbench, photographs: list[Path], lp: Any, tmp_path: Path
) -> None:
    found, pairs = bench.estimate(photographs[:2], None, True, GENERAL)
    ran = lp("estimate", f"images=[{photographs[0]},{photographs[1]}]", f"hydra.run.dir={tmp_path}/run")
    assert ran.status == 0, ran.err
    row = list(csv.DictReader((tmp_path / "run" / "poses.csv").open()))[1]
    latitude, longitude, _ = np.degrees(found.relative[1].numpy())
    assert latitude == pytest.approx(float(row["relative_latitude_degrees"]), abs=1e-3)
    assert longitude == pytest.approx(float(row["relative_longitude_degrees"]), abs=1e-3)
    assert in_words(*found.relative[1, :2].tolist()) == row["answer"]
    (pair,) = pairs
    assert list(pair.landscapes) == ["energy of the model"]
    assert pair.trajectories is not None
    assert pair.trajectories.shape == (4, 51, 3)


def test_a_place_of_a_scene_has_the_energies_of_its_landscapes(bench: Workbench) -> None:
    scene = bench.scene("cup", 0, 1, PAPER)
    latitude, longitude = landscape_grid()
    pose = [float(latitude[5]), float(longitude[7]), float(scene.pair.truth[2])]
    place = bench.place(scene, pose, ["langevin", "two_stage"])
    for name, landscape in scene.pair.landscapes.items():
        assert place.energies[name] == pytest.approx(float(landscape.energy[5, 7]), rel=1e-4)
    assert place.view.shape == (32, 32, 3) or place.view.ndim == 3
    assert list(place.solved) == ["langevin", "two_stage"]
    assert place.refusals == {}
    starts = place.solved["langevin"].starts
    assert np.allclose(starts, [pose])


def test_a_solver_that_refuses_a_start_leaves_the_others(bench: Workbench) -> None:
    scene = bench.scene("cup", 0, 1, PAPER)
    place = bench.place(scene, [0.0, 0.0, -1.5], ["ifusion", "langevin"])
    assert list(place.solved) == ["langevin"]
    assert "starts with relative radii between" in place.refusals["ifusion"]
    nothing = replace(place.solved["langevin"], ends=np.full((1, 3), np.nan))
    assert end_of(nothing) == ("no pose", "", "")


def test_an_answer_to_all_photographs_at_once_is_drawn_too(bench: Workbench, photographs: list[Path]) -> None:
    fast = Choice("multiview", {"iterations": 1, "refinement_steps": 1})
    found, pairs = bench.estimate(photographs, None, True, replace(PAPER, solver=fast))
    for pair, relative in zip(pairs, found.relative[1:], strict=True):
        assert np.allclose(pair.ends[pair.chosen], relative)
        assert map_plot(pair.finite()).data


def test_the_bundled_prior_is_said_not_to_support_photographs(
    bench: Workbench, photographs: list[Path], jobs: Jobs
) -> None:
    fast = replace(PAPER, solver=Choice("ifusion", {"steps": 1}))
    name = jobs.submit(lambda: bench.estimate(photographs[:2], None, True, fast))
    jobs.result(name)
    assert any(text.startswith(TINY_WARNING) for text in jobs.warnings(name))


def test_one_model_is_in_memory_at_a_time(bench: Workbench) -> None:
    one = bench.model("score")
    assert bench.model("score") is one
    assert bench.model("general") is not one
    assert bench.model("score") is not one


# ---------------------------------------------------------------- words


def relief(second: float) -> Landscape:
    """A landscape with a valley at longitude 60 and one at 240, higher by `second` of its range."""
    latitude, longitude = landscape_grid()
    valleys = [(60.0, 0.0), (240.0, second)]
    depth = [
        height + (1 - height) * (1 - torch.exp(8 * (torch.cos(longitude - math.radians(place)) - 1)))
        for place, height in valleys
    ]
    energy = torch.minimum(*depth) + latitude.square()[:, None]
    return Landscape(latitude, longitude, 0.0, energy / energy.max())


def test_a_second_minimum_is_named_where_it_is_nearly_as_deep() -> None:
    said = second_minimum("energy of the prior", relief(0.02))
    assert "120° to the left" in said
    assert "1% of its range above" in said
    assert second_minimum("energy of the prior", relief(0.6)) == ""


def test_the_models_second_answer_takes_precedence_over_minima() -> None:
    view = View(Path("a.png"), np.zeros((4, 4, 3), np.uint8), np.zeros(3))
    pair = ShownPair("a and b", "unlabelled", "", view, view, landscapes={PRIOR_ENERGY: relief(0.02)})
    second = Answer(0.0, math.pi, 0.31)
    assert warnings_of(Answer(0.0, 0.0, 0.6, second), pair) == [
        "It may also be 180° round, probability 0.31 (about half a turn away: front and back look alike)."
    ]
    assert warnings_of(Answer(0.0, 0.0, 0.99), pair) == [second_minimum(PRIOR_ENERGY, relief(0.02))]


# ---------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def address(bench: Workbench, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    from werkzeug.serving import make_server

    runs = tmp_path_factory.mktemp("runs")
    (runs / "eval" / "first").mkdir(parents=True)
    (runs / "eval" / "first" / "report.html").write_text("<h1>the first run</h1>")
    (runs / "eval" / "lr=1, #2").mkdir()
    (runs / "eval" / "lr=1, #2" / "report.html").write_text("<h1>the second run</h1>")
    (runs / "secret.txt").write_text("secret")
    views = {"cup": 4, "tram": 4, "vase": 2}
    jobs, visitors = Jobs(), Visitors()
    server = make_server("127.0.0.1", 0, make_app(bench, jobs, visitors, "tram", views, runs, 1).server, threaded=True)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.port}"
    server.shutdown()
    jobs.close()
    visitors.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture
def visit(browser: Any, address: str) -> Iterator[Any]:
    """`visit(width)`: the app, opened by a new visitor; there must have been neither errors nor foreign requests."""
    contexts, wrong = [], []

    def open_app(width: int = 1200) -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        known = (address, "data:", "blob:")
        page.on("request", lambda request: wrong.append(request.url) if not request.url.startswith(known) else None)
        page.goto(address)
        page.wait_for_selector("#estimate-run")
        return page

    yield open_app
    for context in contexts:
        context.close()
    assert wrong == []


def send(page: Any, *files: Path) -> None:
    page.set_input_files("#photographs input[type=file]", [str(file) for file in files])


@with_browser
def test_two_visitors_get_their_own_answers_and_files(visit: Any, photographs: list[Path]) -> None:
    one, other = visit(), visit(390)
    for page, files in ((one, photographs[:2]), (other, photographs[1:])):
        send(page, *files)
        page.wait_for_selector("#thumbnails img >> nth=1")
        page.click("#estimate-run")
    for page, files in ((one, photographs[:2]), (other, photographs[1:])):
        page.wait_for_selector("#estimate-words .answer")
        said = page.inner_text("#estimate-words")
        assert f"from {files[0].name} to {files[1].name}" in said
        assert "probability" in said
        page.wait_for_selector("#estimate-map .contourlayer")
        assert page.evaluate("document.documentElement.scrollWidth") <= page.viewport_size["width"]
    with one.expect_download() as download:
        one.click("#estimate-download")
    names = zipfile.ZipFile(io.BytesIO(Path(download.value.path()).read_bytes())).namelist()
    assert {"cameras/transforms.json", "cameras/images/000.png", "cameras/report.html"} <= set(names)
    one.click("#tab-Estimate summary:has-text('Method')")
    one.click("#tab-Estimate .field:has(> label:text-is('Solver')) .dash-dropdown")
    one.click(".dash-dropdown-option:has-text('features')")
    one.click("#estimate-run")  # without a network there is no landscape, and least of all the one before
    one.wait_for_selector("#estimate-shown:not([hidden]) #estimate-landscapes[hidden]", state="attached")
    one.click("#estimate-clear")
    one.wait_for_selector("#estimate-words", state="hidden")
    one.wait_for_selector("#thumbnails:not(:has(img))", state="attached")


@with_browser
def test_a_wrong_file_is_answered_in_a_sentence(visit: Any, photographs: list[Path], tmp_path: Path) -> None:
    page = visit()
    page.click("#estimate-run")
    page.wait_for_selector("#estimate-error:has-text('at least two photographs of one object')")
    (tmp_path / "notes.png").write_text("no image")
    send(page, tmp_path / "notes.png", photographs[0])
    page.wait_for_selector("#estimate-error:has-text('notes.png: is not a readable image')")
    assert "lp-app" not in page.inner_text("#estimate-error")
    noise = Image.frombytes("RGB", (800, 700), np.random.default_rng(0).bytes(3 * 800 * 700))
    noise.save(tmp_path / "large.bmp")
    send(page, tmp_path / "large.bmp", photographs[0])
    page.wait_for_selector("#estimate-error:has-text('larger than 1 MB together')")
    send(page, *photographs[:2])
    page.wait_for_selector("#thumbnails img >> nth=1")
    assert page.inner_text("#estimate-error") == ""


@with_browser
def test_an_app_that_has_ended_is_noticed(browser: Any, bench: Workbench, tmp_path: Path) -> None:
    from werkzeug.serving import make_server

    jobs, visitors = Jobs(), Visitors()
    app = make_app(bench, jobs, visitors, "tram", {"cup": 4, "tram": 4}, tmp_path, 1)
    server = make_server("127.0.0.1", 0, app.server, threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = browser.new_page()
    page.goto(f"http://127.0.0.1:{server.port}")
    page.wait_for_selector("#estimate-run")
    assert page.locator(".connection").is_hidden()
    server.shutdown()
    server.server_close()
    page.click("#estimate-run")
    page.wait_for_selector(".connection:has-text('The app does not answer')")
    page.close()
    jobs.close()
    visitors.close()


@with_browser
def test_the_choices_are_those_that_there_are(visit: Any) -> None:
    page = visit()
    page.click("summary:has-text('Method')")
    assert options(page, "#estimate-checkpoint") == ["general", "score"]
    page.click("text=Explore")
    assert options(page, "#explore-query") == ["0", "1", "2", "3"]
    page.click("#explore-object")
    page.click(".dash-dropdown-option:has-text('vase')")
    until = time.monotonic() + 20
    while options(page, "#explore-query") != ["0", "1"]:
        assert time.monotonic() < until


def options(page: Any, dropdown: str) -> list[str]:
    page.click(dropdown)
    page.wait_for_selector(".dash-dropdown-option")
    found = [text.strip() for text in page.locator(".dash-dropdown-option").all_inner_texts()]
    page.keyboard.press("Escape")
    return found


@with_browser
def test_a_landscape_is_explored_by_a_click_and_by_the_sliders(visit: Any) -> None:
    page = visit()
    page.click("text=Explore")
    page.click("#explore-show")
    page.wait_for_selector("#explore-map .contourlayer")
    page.wait_for_selector("#explore-surface canvas")
    page.locator("#explore-map").scroll_into_view_if_needed()
    box = page.locator("#explore-map .nsewdrag").first.bounding_box()
    x, y = box["x"] + 0.6 * box["width"], box["y"] + 0.4 * box["height"]
    page.mouse.move(x, y)  # once: Plotly passes over moves that follow at once, and a click is where it last looked
    page.wait_for_selector("#explore-map .hoverlayer .hovertext")
    page.mouse.click(x, y)

    latitude, longitude = place(page)
    assert abs(latitude - 12) <= 10
    assert abs(longitude - 216) <= 4
    assert page.locator("#explore-place tbody tr").count() == 3
    assert page.locator("#explore-shown .view img").count() == 3  # reference, query, generated
    page.focus("#explore-longitude [role=slider]")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(f"#explore-place h3:has-text('longitude {longitude + 1}°')")


def place(page: Any) -> tuple[int, int]:
    """The latitude and the longitude of the place that is shown."""
    page.wait_for_selector("#explore-place h3:not(:has-text('longitude 0°'))")
    found = re.match(r"Latitude (\S+)°, longitude (\d+)°", page.inner_text("#explore-place h3"))
    assert found
    return int(found[1].replace("\N{MINUS SIGN}", "-")), int(found[2])


@with_browser
def test_pages_of_runs_are_served_and_nothing_else(visit: Any, address: str) -> None:
    page = visit()
    page.click("text=Runs")
    for name, heading in (("first", "the first run"), ("lr=1, #2", "the second run")):
        with page.expect_popup() as popup:
            page.click(f"text=eval/{name}")
        assert popup.value.inner_text("h1") == heading
    for path in ("secret.txt", "eval/..%2f..%2fsecret.txt", "eval/none/report.html"):
        assert page.request.get(f"{address}/runs/{path}").status == 404


def test_the_command_without_dash_says_how_to_get_it(lp: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "dash", None)
    ran = lp("app", "port=0")
    assert ran.status == 1
    assert "pip install 'lp_framework[app]'" in ran.error


def test_a_limit_that_is_no_number_is_refused(lp: Any) -> None:
    ran = lp("app", "upload_megabytes=0")
    assert ran.status == 1
    assert "upload_megabytes must be a positive number, got 0" in ran.error


def test_a_port_in_use_is_named(lp: Any) -> None:
    import socket

    with socket.socket() as taken, warnings.catch_warnings():
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ran = lp("app", f"port={port}")
    assert ran.status == 1
    assert f"host=127.0.0.1 port={port}: the app cannot listen there (Address already in use" in ran.error
