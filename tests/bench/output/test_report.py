from __future__ import annotations

import io
import json
import math
import re
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fathom.bench.cli import app as cli
from fathom.bench.experiment.plan import Experiment
from fathom.bench.output import present as presenting
from fathom.bench.output.cells import ACCURACY, spans
from fathom.bench.output.estimates import load_trajectory
from fathom.bench.output.report.page import ordinal, render
from fathom.bench.output.report.results import differences_of, in_order, kept_plan
from fathom.bench.output.tables.table import print_table
from fathom.bench.results.intervals import interval_over_seeds
from fathom.bench.results.store import load_runs
from rich.console import Console
from typer.testing import CliRunner

SHOWN = [column.score for column in ACCURACY]

pytestmark = pytest.mark.slow  # every test reads the page of a whole experiment, most of them in a browser

EXPERIMENT = """
description: "Does smoothing pay? <b>Not bold</b> & short."
logs: [{scenario: {duration_s: 40}}]
estimators:
  - {name: dead-reckoning}
  - {name: eskf}
  - {name: rts}
  - {name: fls, label: fls cholesky, with: {factorization: CHOLESKY}}
seeds: [1, 2]
baseline: eskf
"""


def call(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `fathom run` leaves of four estimators, one of which diverges, on a short dive from two seeds."""
    place = tmp_path_factory.mktemp("report")
    (place / "dives.yaml").write_text(EXPERIMENT)
    code, _, err = call("run", place / "dives.yaml", "--out", place / "results", "--jobs", 1)
    assert code == 1, err
    assert "report.html" in err
    return place / "results" / "dives"


@pytest.fixture(scope="module")
def rows(folder: Path) -> pd.DataFrame:
    return in_order(load_runs(folder), folder)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's Chromium; skips where it is not."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no browser: `chromium` is not there (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield started
        started.close()


@dataclass
class Watch:
    """What a page did besides being read."""

    requests: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def attach(self, page: Any) -> None:
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("console", lambda message: self.said.append(message.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("dialog", lambda dialog: (self.said.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        page.route(re.compile("^(?!file:)"), lambda route: route.abort())


@contextmanager
def opened(browser: Any, file: Path) -> Iterator[Any]:
    """Open a page, and hold it to this: nothing but the file is asked for, and it has nothing to complain of."""
    watch, page = Watch(), browser.new_page(viewport={"width": 1280, "height": 900})
    try:
        watch.attach(page)
        page.goto(file.as_uri())
        yield page
    finally:
        page.close()
    assert watch.requests == [file.as_uri()]
    assert watch.said == []


@pytest.fixture(scope="module")
def page(folder: Path, browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The report, copied alone to another folder and opened, for all tests that leave it as they found it."""
    file = tmp_path_factory.mktemp("alone") / "alone.html"
    shutil.copy(folder / "report.html", file)
    with opened(browser, file) as page:
        yield page


def drawn(page: Any, kind: str) -> Any:
    """Scroll to the first figure of a kind and return it, drawn."""
    plot = page.locator(f".plot[data-kind={kind}]").first
    plot.scroll_into_view_if_needed()
    plot.locator(".main-svg").first.wait_for()
    return plot


def column(page: Any, sheet: int, index: int) -> list[list[str | None]]:
    """Return what a column of the sheet is sorted by, group by group, from top to bottom."""
    script = """([sheet, index]) => [...[...document.querySelectorAll("table")].at(sheet).tBodies].map((body) =>
        [...body.rows].filter((row) => !row.matches(".group, .detail")).map((row) => row.cells[index].dataset.value))"""
    return page.evaluate(script, [sheet, index])


def page_of(rows: pd.DataFrame, folder: Path, place: Path, differences: Any = ()) -> Path:
    """Write the page of these rows into a folder of its own."""
    place.mkdir(exist_ok=True)
    file = place / "page.html"
    file.write_text(render(rows, folder, differences), encoding="utf-8")
    return file


# -- in a browser -----------------------------------------------------------------------------------------------------


def test_the_page_alone_opens_and_draws_every_figure_without_network_or_complaint(page: Any) -> None:
    assert page.title() == "dives · Fathom"
    for kind in ("tracks", "errors", "anees", "costs"):
        assert drawn(page, kind).locator(".scatterlayer .trace").count() >= 3
    outside = page.evaluate(
        """[...document.querySelectorAll("[src], [href]")]
        .map((one) => one.getAttribute("src") ?? one.getAttribute("href"))
        .filter((to) => !to.startsWith("#"))"""
    )
    assert outside == []


def test_a_figure_can_be_saved_and_has_no_button_that_sends_it_anywhere(page: Any) -> None:
    plot = drawn(page, "tracks")
    titles = plot.locator(".modebar-btn").evaluate_all("buttons => buttons.map((button) => button.dataset.title)")
    assert titles == ["Download plot", "Zoom", "Pan", "Zoom in", "Zoom out", "Reset axes"]
    with page.expect_download() as download:
        plot.locator(".modebar-btn").first.click(force=True)
    assert download.value.path().read_text(encoding="utf-8").startswith("<svg")


def test_the_watch_sees_a_request(folder: Path, browser: Any, tmp_path: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    beacon = '<img src="http://127.0.0.1:9/seen.png" alt="">'
    (tmp_path / "leaky.html").write_text(text.replace("</main>", f"{beacon}</main>"), encoding="utf-8")
    with pytest.raises(AssertionError), opened(browser, tmp_path / "leaky.html") as page:
        page.wait_for_timeout(100)


def test_the_first_table_says_what_table_csv_and_the_terminal_say(rows: pd.DataFrame, folder: Path, page: Any) -> None:
    written = io.StringIO()
    print_table(rows, Console(file=written, width=120))
    csv = pd.read_csv(folder / "table.csv", dtype=str).set_index(["label", "output"])
    sheet = page.locator("#accuracy ~ .sheet table").first
    told = sheet.evaluate(
        """table => [...table.tBodies].flatMap((body) => [...body.rows].slice(1).map((row) => [row.cells[0].innerText,
        body.rows[0].innerText.includes("smoothed") ? "smoothed" : "online",
        [...row.cells].slice(2).map((cell) => [cell.dataset.value ?? null, cell.innerText])]))"""
    )
    assert {(label, output) for label, output, _ in told} == set(csv.index)
    for label, output, cells in told:
        for name, (value, _) in zip(SHOWN, cells, strict=True):
            known = csv.loc[(label, output), name]
            assert (value is None and pd.isna(known)) or float(value) == float(known), (label, output, name)
        printed = r"\s+".join(re.escape(text) for _, text in cells)
        assert re.search(printed, written.getvalue()), (label, output)


def test_failures_stand_at_the_top_with_cause_and_time(rows: pd.DataFrame, page: Any) -> None:
    lost = rows[rows["status"] == "diverged"].iloc[0]
    first = page.locator("main section").first.inner_text()
    assert lost["cause"].strip() in first
    for said in ("fls cholesky", "1–2", "diverged", f"{lost['failed_at_s']:.1f}"):
        assert said in first
    assert "8: 6 done, 2 diverged" in page.locator(".facts").inner_text()


def test_a_header_sorts_numbers_by_size_both_ways_each_lookahead_by_itself(page: Any) -> None:
    sheet = page.evaluate("[...document.querySelectorAll('table')].findIndex((t) => t.closest('#failures') === null)")
    before = column(page, sheet, 9)
    header = page.locator("table").nth(sheet).locator("thead th").nth(9)
    assert header.inner_text() == "× real time"
    header.locator("button").click()
    up = column(page, sheet, 9)
    header.locator("button").focus()
    page.keyboard.press("Enter")
    assert header.get_attribute("aria-sort") == "descending"
    down = column(page, sheet, 9)
    for was, risen, fallen in zip(before, up, down, strict=True):
        numbers = [float(value) for value in was if value is not None]
        absent = [None] * (len(was) - len(numbers))
        assert risen == [*map(str, sorted(numbers)), *absent]
        assert fallen == [*map(str, sorted(numbers, reverse=True)), *absent]
    assert len(before) == 3  # online, smoothed, and who said nothing


def test_sorting_is_stable_sorts_numbers_in_words_and_leaves_the_absent_last(
    rows: pd.DataFrame, folder: Path, browser: Any, tmp_path: Path
) -> None:
    one = rows[(rows["label"] == "eskf") & (rows["seed"] == 1)]
    ate = {"fls lag 10": 2.0, "fls lag 9": 10.0, "fls lag 100": 1e-5, "a": math.nan, "b": 2.0}
    many = pd.concat([one.assign(label=label, ate_rmse_m=value) for label, value in ate.items()], ignore_index=True)
    with opened(browser, page_of(many, folder, tmp_path)) as page:
        headers = page.locator("table").first.locator("thead button")

        def labels() -> list[str | None]:
            return column(page, 0, 0)[0]

        headers.nth(2).click()
        assert labels() == ["fls lag 100", "fls lag 10", "b", "fls lag 9", "a"]
        headers.nth(2).click()
        assert labels() == ["fls lag 9", "fls lag 10", "b", "fls lag 100", "a"]
        headers.nth(0).click()
        assert labels() == ["a", "b", "fls lag 9", "fls lag 10", "fls lag 100"]


def test_a_drag_zooms_and_a_double_click_goes_back(page: Any) -> None:
    for kind in ("tracks", "errors", "costs"):
        plot = drawn(page, kind)
        whole = plot.evaluate("plot => plot.layout.xaxis.range.slice()")
        box = plot.locator(".nsewdrag").first.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 80, y + 60, steps=4)
        page.mouse.up()
        page.wait_for_function(
            "([plot, was]) => plot.layout.xaxis.range[0] > was[0]", arg=[plot.element_handle(), whole]
        )
        zoomed = plot.evaluate("plot => plot.layout.xaxis.range.slice()")
        assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
        page.mouse.dblclick(x, y)
        back = "([plot, was]) => Math.abs(plot.layout.xaxis.range[0] - was[0]) < 1e-6 * Math.abs(was[1] - was[0])"
        page.wait_for_function(back, arg=[plot.element_handle(), whole])


def test_a_figure_holds_what_the_trajectories_say(rows: pd.DataFrame, folder: Path, page: Any) -> None:
    row = rows[(rows["label"] == "eskf") & (rows["seed"] == 2)].iloc[0]
    estimate, truth = (
        load_trajectory(folder / "trajectories" / row[name]) for name in ("trajectory", "truth_trajectory")
    )
    assert estimate.P is not None
    page.locator("select.seed").select_option(label="2")
    page.locator("select.estimator").select_option(label="eskf")
    tracks, errors = (
        drawn(page, kind).evaluate("plot => plot.data.map((t) => ({name: t.name, x: [...t.x], y: [...t.y]}))")
        for kind in ("tracks", "errors")
    )
    scale = drawn(page, "tracks").evaluate("({_fullLayout: {xaxis, yaxis}}) => xaxis._m / yaxis._m")
    assert scale == pytest.approx(-1)  # a metre east is as long as a metre north
    track = next(trace for trace in tracks if trace["name"] == "eskf")
    assert np.stack([track["x"], track["y"]], axis=1) == pytest.approx(estimate.p_WB_W[:, :2], abs=1e-4)
    lower, upper, east = errors[:3]
    assert east["y"] == pytest.approx((estimate.p_WB_W - truth.p_WB_W)[:, 0], abs=1e-6)
    assert upper["y"] == pytest.approx(3 * np.sqrt(estimate.P[:, 3, 3]), rel=1e-5)
    assert lower["y"] == pytest.approx(-np.array(upper["y"]))


def test_a_run_opens_to_its_spec_and_travels_with_it_when_sorted(rows: pd.DataFrame, page: Any) -> None:
    run = rows[(rows["label"] == "rts") & (rows["seed"] == 2) & (rows["output"] == "online")].iloc[0]
    place = list(rows["identity"] + rows["output"]).index(run["identity"] + "online")
    page.locator("#filter").fill(f"{run['identity'][:8]} online")
    assert page.locator("#filtered").inner_text() == f"1 of {len(rows)}"
    button = page.locator(f"tr[data-run='{place}'] .opens")
    button.focus()
    page.keyboard.press("Enter")
    assert button.get_attribute("aria-expanded") == "true"
    shown = json.loads(page.locator(".detail pre").inner_text())
    assert shown == json.loads(run["spec"])
    text = page.locator(".detail").inner_text()
    assert all(said in text for said in (run["identity"], run["commit_id"], str(run["ate_rmse_m"]), run["finished"]))
    page.locator("#filter").fill("")
    page.locator("table.runs thead button").nth(2).click()
    before = page.locator(".detail").evaluate("row => row.previousElementSibling.dataset.run")
    assert before == str(place)
    button.click()
    assert page.locator(".detail").count() == 0


HOSTILE = """</script><script>alert("x")</script><img src=x onerror=alert(1)><a href='http://e.x'>"'&amp; %{x} $x$"""


def test_hostile_text_is_inert(rows: pd.DataFrame, folder: Path, browser: Any, tmp_path: Path) -> None:
    spec = json.dumps({"estimator": {"name": HOSTILE}, HOSTILE: 1})
    notes, tame_notes = (
        json.dumps([{"kind": kind, "text": text} for kind in ("damage", "about")]) for text in (HOSTILE, "cut off")
    )
    bad = rows.assign(
        log=HOSTILE, experiment=HOSTILE, notes=notes, counts=json.dumps({HOSTILE: 3}), spec=spec,
        machine=json.dumps({"cpu": HOSTILE}), start=HOSTILE, identity=HOSTILE, truth_kind=HOSTILE,
        label=rows["label"] + HOSTILE, cause=rows["cause"].mask(rows["cause"].notna(), HOSTILE),
    )  # fmt: skip
    known = differences_of(folder)
    tame = page_of(rows.assign(notes=tame_notes), folder, tmp_path / "tame", known)
    differences = [{**row, "label": HOSTILE, "baseline_label": HOSTILE} for row in known]
    count = """["script", "img", "a", "iframe"].map((kind) => document.body.querySelectorAll(kind).length)"""
    elements = []
    for file in (tame, page_of(bad, folder, tmp_path / "bad", differences)):
        with opened(browser, file) as page:
            for kind in ("tracks", "errors", "anees", "costs"):
                drawn(page, kind)
            page.locator(".opens").first.click()
            elements.append(page.evaluate(count))
            text = page.locator("body").inner_text()
            legend = page.locator(".legendtext").all_text_contents()
    assert elements[0] == elements[1]
    assert HOSTILE in text
    assert any("<img src=x onerror=alert(1)>" in name for name in legend)


@pytest.mark.parametrize(("width", "scheme"), [(400, "dark"), (1280, "light")])
def test_nothing_but_tables_is_wider_than_the_screen_and_colours_follow_the_system(
    page: Any, width: int, scheme: str
) -> None:
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 800})
    drawn(page, "errors")
    page.wait_for_function("width => document.documentElement.scrollWidth === width", arg=width)
    paper, ink = page.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
    )
    lightness = [sum(map(int, re.findall(r"\d+", colour))) / 765 for colour in (paper, ink)]
    assert (lightness[0] > lightness[1]) == (scheme == "light")
    tick = "ink => getComputedStyle(document.querySelector('.plot[data-kind=errors] .xtick text')).fill === ink"
    page.wait_for_function(tick, arg=ink)


# -- from any store ---------------------------------------------------------------------------------------------------


def many(rows: pd.DataFrame, seeds: int, labels: int) -> pd.DataFrame:
    """As many estimators and seeds as asked for, all of which said what `rts` did."""
    two = rows[(rows["label"] == "rts") & (rows["seed"] == 1)]
    copies = [
        two.assign(
            label=f"rts {k}", seed=seed, identity=f"{seed:04x}{k:04x}", ate_rmse_m=two["ate_rmse_m"] * (1 + seed)
        )
        for seed in range(seeds)
        for k in range(labels)
    ]
    return pd.concat(copies, ignore_index=True).astype({"seed": "Int64"})


def test_an_hour_of_eight_estimators_and_three_seeds_stays_small_and_says_how_it_was_thinned(
    rows: pd.DataFrame, folder: Path, tmp_path: Path
) -> None:
    hour = 3360
    (tmp_path / "trajectories").mkdir()
    for name in ("trajectory", "truth_trajectory"):
        for file in rows.loc[(rows["label"] == "rts") & (rows["seed"] == 1), name].unique():
            short = pd.read_parquet(folder / "trajectories" / file)
            long = short.iloc[np.arange(hour) % len(short)].assign(t_ns=np.arange(hour) * 10**9)
            long.to_parquet(tmp_path / "trajectories" / file, index=False)
    text = render(many(rows, 3, 8), tmp_path, ())
    assert len(text) < 15e6
    assert "Every 2nd of 3,360 poses is shown." in text
    assert text.count('class="tracks"') == 3


def test_hundreds_of_runs_stay_usable(rows: pd.DataFrame, folder: Path, browser: Any, tmp_path: Path) -> None:
    every = many(rows, 60, 4)
    every["trajectory"] = every["trajectory"].where(every["label"] == "rts 0", None)
    page_file = page_of(every, folder, tmp_path)
    assert page_file.stat().st_size < 15e6
    with opened(browser, page_file) as page:
        assert page.locator("tr[data-run]").count() == 480
        assert page.locator("select.seed option").count() == 10
        drawn(page, "tracks")
        assert "50 more seeds are not drawn" in page.locator("figcaption").first.inner_text()
        page.locator("table.runs thead button").nth(3).click()
        ate = [[float(value) for value in group if value] for group in column(page, -1, 3)]
        assert all(group == sorted(group) and len(group) == 240 for group in ate)
        page.locator("#filter").fill("00250002")
        assert page.locator("tr[data-run]:visible").count() == 2
        interval = page.locator("#accuracy ~ .sheet .interval").first.inner_text()
        assert re.fullmatch(r"\[[\d.,]+, [\d.,]+\]", interval)


def test_of_thousands_of_runs_those_that_are_scrolled_to_are_made_and_all_are_sorted_searched_and_opened(
    rows: pd.DataFrame, folder: Path, browser: Any, tmp_path: Path
) -> None:
    two = rows[(rows["label"] == "rts") & (rows["seed"] == 1)]
    every = two.loc[two.index.repeat(1500)].reset_index(drop=True)
    seeds = np.tile(np.arange(1500), 2)
    shuffled = np.random.default_rng(1).permutation(1500)[seeds]
    every = every.assign(
        seed=pd.array(seeds, "Int64"),
        identity=[f"{seed:08x}" for seed in seeds],
        ate_rmse_m=1.0 + shuffled / 7,
        trajectory=None,
    )
    file = page_of(every, folder, tmp_path)
    assert file.stat().st_size < 3e6
    with opened(browser, file) as page:
        made = page.locator("tr[data-run]")
        made.nth(999).wait_for(state="attached")
        assert made.count() == 1000
        for last in (1999, 2999):
            page.locator("#more").scroll_into_view_if_needed()
            made.nth(last).wait_for(state="attached")
        assert not page.locator("#more").is_visible()
        header = page.locator("table.runs thead button").nth(3)
        header.click()
        header.click()
        first = column(page, -1, 3)[0]
        assert len(first) == 1000
        assert [float(value or 0) for value in first] == pytest.approx((1.0 + np.arange(1499, 499, -1) / 7), rel=1e-5)
        page.locator("#filter").fill("000005db online")  # far below what is made
        assert page.locator("#filtered").inner_text() == "1 of 3000"
        page.locator("tr[data-run] .opens").click()
        assert json.loads(page.locator(".detail pre").inner_text())["seed"] == 1499
        page.locator("#filter").fill("no such run")
        assert made.count() == 0
        page.locator("#filter").fill("")
        assert made.count() == 1000


def test_causes_beyond_what_one_reads_are_left_to_the_table_of_runs(rows: pd.DataFrame, folder: Path) -> None:
    one = rows.iloc[[0]]
    every = one.loc[one.index.repeat(300)].reset_index(drop=True)
    every = every.assign(
        seed=pd.array(range(300), "Int64"), status="failed", cause=[f"unlike the others: {k}" for k in range(300)]
    )
    text = render(every.assign(trajectory=None), folder, ())
    assert text.count(">unlike the others") == 200
    assert "and 100 more; the table of runs has them all" in text


def test_what_a_store_lacks_is_reported_and_the_rest_is_shown(
    rows: pd.DataFrame, folder: Path, browser: Any, tmp_path: Path
) -> None:
    done = rows[rows["label"] == "eskf"]
    blind = done.iloc[:1].assign(
        log="no truth", seed=pd.NA, truth_kind=None, truth_trajectory=None, nees_at=None, ate_rmse_m=math.nan
    )
    absent = rows.iloc[:1].assign(
        log="gone", seed=pd.NA, status="absent", cause="not here: gone", trajectory=None, truth_trajectory=None,
        truth_kind=None, lookahead_s=math.nan, nees_at=None, counts=None, spec=None, notes=None, versions=None,
        machine=None, commit_id=None, identity=None, failed_at_s=math.nan, **dict.fromkeys(SHOWN, math.nan),
    )  # fmt: skip
    failed = absent.assign(log="broken", seed=1, status="failed", cause="OSError: no disk", failed_at_s=3.25)
    lost = done.assign(log="lost files", trajectory="no such.parquet")
    cut = done.iloc[:1].assign(log="cut off", trajectory="cut.parquet")
    shutil.copytree(folder / "trajectories", tmp_path / "trajectories")
    (tmp_path / "trajectories" / "cut.parquet").write_bytes(b"PAR1 and no more")
    parts = [blind, absent, failed, lost, cut, done.iloc[:1].assign(log="one seed", machine='{"cpu": "other"}')]
    with opened(browser, page_of(pd.concat(parts, ignore_index=True), tmp_path, tmp_path / "page")) as page:
        text = page.locator("main").inner_text()
        for k in range(page.locator(".plot").count()):
            plot = page.locator(".plot").nth(k)
            plot.scroll_into_view_if_needed()
            plot.locator(".main-svg").first.wait_for()
        assert "7: 5 done, 1 failed, 1 absent" in page.locator(".facts").inner_text()
    for said in (
        "not here: gone", "OSError: no disk", "3.2", "no ground truth to score against",
        "there is no ground truth to compare them with",
        "lost files: trajectories are missing from the figures: no such.parquet: not there, and 1 more",
        "cut off: trajectories are missing from the figures: cut.parquet: ArrowInvalid",
        "There is nothing to draw", "made with 3 machines", "not recorded", "no intervals: they need 5 seeds",
    ):  # fmt: skip
        assert said in text


def test_the_store_of_another_version_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as store, store:
        store.execute("CREATE TABLE runs (experiment, log, label, seed, output, status, cause, ate_rmse_m, n_scored)")
    code, out, err = call("report", tmp_path, "-o", tmp_path / "new" / "page.html")
    assert (code, out) == (2, "")
    assert "another version wrote it" in err
    assert "move it away" in err


def test_report_finds_a_result_by_name_and_writes_what_run_wrote(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parents[1])
    assert call("report", "dives", "-o", tmp_path / "again.html")[0] == 0
    known = [path.read_text(encoding="utf-8") for path in (folder / "report.html", tmp_path / "again.html")]
    undated = [re.sub(r"written [-0-9: ]+UTC", "", text).replace(str(folder), "results/dives") for text in known]
    assert undated[0] == undated[1]
    code, out, err = call("report", "divse")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "divse: no such result; did you mean 'dives'? (in results: dives)" in err


def test_report_refuses_in_one_line_what_it_cannot_use(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "junk").mkdir()
    (tmp_path / "junk" / "runs.sqlite").write_text("no store")
    for arguments, says in (
        ((tmp_path / "junk",), "cannot be read as a store"),
        ((tmp_path / "nothing",), "no such result"),
        (("x" * 300,), "no such result"),
        ((folder, "-o", tmp_path), "choose another place by -o"),
    ):
        code, out, err = call("report", *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert says in err


def test_without_the_extra_report_is_refused_and_run_says_how_to_get_it(
    rows: pd.DataFrame,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    code, out, err = call("report", folder)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "pip install 'fathom-bench[report]'" in err
    plan = Experiment.load(folder / "experiment.yaml")
    presenting._write_report(rows, plan, tmp_path, [])
    said = capsys.readouterr().err
    assert "no report.html: " in said
    assert "pip install 'fathom-bench[report]'" in said
    assert not (tmp_path / "report.html").exists()


def test_the_kept_plan_is_the_experiment(folder: Path) -> None:
    kept, again = kept_plan(folder, "dives")
    asked = Experiment.load(folder.parents[1] / "dives.yaml")
    assert kept is not None
    assert [kept.spec(run) for run in kept.runs()] == [asked.spec(run) for run in asked.runs()]
    assert (kept.name, kept.description, kept.comparisons()) == (asked.name, asked.description, asked.comparisons())
    assert again == str(folder / "experiment.yaml")
    assert kept_plan(folder / "nowhere", "smoke")[1] == "smoke"


def test_rows_come_in_the_order_of_the_plan(rows: pd.DataFrame, folder: Path) -> None:
    mixed = rows.sample(frac=1, random_state=3)
    assert in_order(mixed, folder)[["label", "seed"]].to_numpy().tolist() == rows[["label", "seed"]].to_numpy().tolist()
    assert list(rows["label"].unique()) == ["dead-reckoning", "eskf", "rts", "fls cholesky"]


def test_the_interval_of_a_mean_is_the_normal_one_where_seeds_are_many() -> None:
    values = np.random.default_rng(4).normal(10, 2, 400)
    found = interval_over_seeds([{"drift_end_percent": value} for value in values], "drift_end_percent")
    half = 1.96 * values.std(ddof=1) / 20
    assert found == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)
    assert interval_over_seeds([{"drift_end_percent": 1.0}] * 4, "drift_end_percent") is None


def test_numbers_are_reported_in_words() -> None:
    assert [ordinal(k) for k in (2, 3, 4, 11, 12, 21, 22, 113)] == [
        *("2nd", "3rd", "4th", "11th", "12th", "21st", "22nd", "113th")
    ]
    assert spans([1, 2, 3, 5, 8, 9]) == "1–3, 5, 8–9"
