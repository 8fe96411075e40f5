"""`xop-curate report`: the page in a real browser, partial data, and how it is written."""

from __future__ import annotations

import json
import re
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from browser import open_page
from curate_data import compute_digests, make_foreign, make_synthetic, rewrite

from xop_lerobot.core.page import dump_script
from xop_lerobot.curate.cli import main
from xop_lerobot.curate.measures import FIGURES
from xop_lerobot.curate.report_page import Limits, Report
from xop_lerobot.curate.source import Source
from xop_lerobot.curate.survey import survey
from xop_lerobot.curate.timeline import decode, encode, thin
from xop_lerobot.recording.facts import CONFIG_FILE, EPISODES_FILE

EPISODES, FRAMES = 6, 100
EVIL = "</script><img src=x onerror=\"document.title='evil'\">"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return make_synthetic(tmp_path_factory.mktemp("made") / "data", EPISODES, FRAMES)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
    return make_foreign(tmp_path_factory.mktemp("foreign") / "data")


@pytest.fixture(scope="module")
def page_file(made, tmp_path_factory) -> Path:
    """The page of a dataset of this project's columns, one of whose tasks means harm."""
    folder = tmp_path_factory.mktemp("page")
    root = Path(shutil.copytree(made, folder / "data"))
    lines = [json.loads(line) for line in (root / EPISODES_FILE).read_text().splitlines()]
    lines[0]["changes"] = [{"frame": 50, "time": 2.0, "source": "user", "change": EVIL}]
    lines[0]["subtasks"] = [["reach", 0, 40], ["lift", 40, 100]]
    (root / EPISODES_FILE).write_text("".join(json.dumps(line) + "\n" for line in lines))
    tracked = np.ones((FRAMES, 3), bool)
    tracked[20:45, 1] = False
    path = root / "data/chunk-000/file-001.parquet"
    flat = pa.array(tracked.reshape(-1))
    kind = pq.read_schema(path).field("operator.tracked").type
    rewrite(path, {"operator.tracked": pa.FixedSizeListArray.from_arrays(flat, 3).cast(kind)})
    assert main(["report", "--root", str(root), "--out", str(folder / "page.html")]) == 0
    return folder / "page.html"


@pytest.fixture(scope="module")
def browser():
    from browser import launch

    with launch() as started:
        yield started


@pytest.fixture
def page(browser, page_file):
    with open_page(browser, page_file) as opened:
        yield opened


def read_figures(path: Path) -> dict:
    """The data of the table."""
    text = path.read_text()
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, re.S)
    assert found
    return json.loads(found[1])


def read_timelines(path: Path) -> list[dict]:
    text = path.read_text()
    pattern = r'<div class="timeline"></div><script type="application/json">(.*?)</script>'
    return [json.loads(found) for found in re.findall(pattern, text, re.S)]


# In a browser.

AREA = """(place) => {
    const view = [...Bokeh.index].find((each) => each.model.id === place.figure);
    const { left, top } = view.el.getBoundingClientRect();
    return [left + view.frame.x_scale.compute(place.x), top + view.frame.y_scale.compute(place.y)];
}"""
"""Where a point of a figure is on the screen."""
FIGURES_OF = """(sheet) => sheet.document.roots().map((figure) => {
    const view = [...Bokeh.index].find((each) => each.model === figure);
    const { width, height } = view.bbox;
    const axes = view.axis_views.map(({ bbox, model }) => ({ label: model.axis_label,
        inside: bbox.left >= 0 && bbox.top >= 0 && bbox.right <= width && bbox.bottom <= height }));
    return { id: figure.id, axes, frame: view.frame.bbox.width / width };
})"""


def show(page, view: str) -> None:
    page.locator(f'#views button[data-view="{view}"]').click()


def open_timelines(page, index: int):
    """Open an episode's timelines and scroll over all of its figures."""
    section = page.locator(f"#episode-{index}")
    section.locator(".timelines").evaluate("each => { each.open = true; }")
    hosts = section.locator(".bands, .panel > div:last-child")
    for place in range(hosts.count()):
        hosts.nth(place).scroll_into_view_if_needed()
        hosts.nth(place).locator(".bk-Figure").wait_for()
    return section


def open_plots(page) -> list[dict]:
    """Show the plots, and scroll over all of them."""
    show(page, "plots")
    hosts = page.locator("[data-plot]")
    for place in range(hosts.count()):
        hosts.nth(place).scroll_into_view_if_needed()
        hosts.nth(place).locator(".bk-Figure").wait_for()
    return page.evaluate(f"({FIGURES_OF})(plots)")


def locate(page, host, x: float, y: float) -> tuple[float, float]:
    """Where a point of the figure in `host` is on the screen, once it is in view."""
    host.scroll_into_view_if_needed()
    figure = host.evaluate("host => [...Bokeh.index].find((v) => host.contains(v.el)).model.id")
    return page.evaluate(AREA, {"figure": figure, "x": x, "y": y})


def read_column(page, name: str) -> list[str]:
    places = page.locator("#table th").evaluate_all("cells => cells.map((c) => c.dataset.name)")
    cells = page.locator(f"#table tbody tr td:nth-child({places.index(name) + 1})")
    return cells.all_inner_texts()


def read_list(page) -> list[str]:
    """The episodes whose sections are shown, in their order."""
    return page.locator(".episode:visible").evaluate_all("all => all.map((e) => e.dataset.episode)")


@pytest.mark.slow
def test_the_page_runs_and_fetches_nothing(page, page_file):
    assert page.title() == "Dataset data"
    open_timelines(page, 5)
    open_plots(page)
    assert page.problems == []
    assert page.requests == [page_file.as_uri()]


@pytest.mark.slow
def test_table_and_list_sort_by_any_figure(page, page_file):
    show(page, "table")
    assert read_column(page, "episode") == [str(index) for index in range(EPISODES)]
    data = read_figures(page_file)
    place = list(FIGURES).index("tracking_p95")
    ranked = sorted(data["rows"], key=lambda row: row[0][place])
    ranked = [str(row[0][0]) for row in ranked]
    head = page.locator('#table th[data-name="tracking_p95"]')
    head.locator("button").click()
    assert read_column(page, "episode") == ranked
    assert head.get_attribute("aria-sort") == "ascending"
    head.locator("button").click()
    assert read_column(page, "episode") == ranked[::-1]
    assert head.get_attribute("aria-sort") == "descending"
    show(page, "episodes")
    assert read_list(page) == ranked[::-1]
    show(page, "table")
    # One that is not among the columns gets there by being chosen; what is unknown comes last.
    for figure in FIGURES:
        page.select_option("#sort", figure)
        values = read_column(page, figure)
        assert len(values) == EPISODES
        assert values == sorted(values, key=lambda text: text == "-")
    page.check("#all")
    assert page.locator("#table th").count() == len(FIGURES)


def test_the_table_leads_to_episodes_and_back(page):
    show(page, "table")
    page.locator("#table tbody a", has_text="4").click()
    section = page.locator("#episode-4")
    page.wait_for_function(
        "() => document.querySelector('#episode-4').getBoundingClientRect().top < 200"
    )
    assert section.locator("h3").inner_text().startswith("Episode 4")
    section.locator(".bk-Figure").first.wait_for()
    show(page, "table")
    assert page.locator("#table").is_visible()
    assert not section.is_visible()


def test_table_and_list_show_a_choice(page, page_file):
    place = list(FIGURES).index("success")
    failed = [row[0][0] for row in read_figures(page_file)["rows"] if row[0][place] is False]
    page.select_option("#choice", "no success")
    assert read_list(page) == list(map(str, failed))
    show(page, "table")
    assert read_column(page, "episode") == list(map(str, failed))
    assert page.inner_text("#count") == f"{len(failed)} of {EPISODES} episodes"


@pytest.mark.slow
def test_plots_have_a_point_an_episode_and_lead_there(page, page_file):
    figures = open_plots(page)
    assert len(figures) >= 9
    assert page.evaluate("plots.source.get_length()") == EPISODES
    error = read_figures(page_file)["rows"][2][0][list(FIGURES).index("tracking_mean")]
    host = page.locator('[data-plot="tracking_mean over episode"]')
    page.mouse.move(*locate(page, host, 2, error))
    tip = page.locator(".bk-Tooltip:visible .bk-tooltip-row-value")
    tip.first.wait_for()
    index, told, _ = tip.all_inner_texts()
    assert int(index) == 2
    assert float(told.removesuffix(" m")) == pytest.approx(error, abs=6e-4)
    page.mouse.click(*locate(page, host, 2, error))
    page.wait_for_url("**#episode-2")
    assert page.locator("#episode-2 .timelines").get_attribute("open") is not None


def test_any_metric_is_plotted_against_any_other(page):
    show(page, "plots")
    page.select_option("#plot-x", "tracking_mean")
    page.select_option("#plot-y", "hand_jerk")
    assert page.locator("#scatter [data-plot]").get_attribute("data-plot") == (
        "hand_jerk over tracking_mean"
    )
    axes = open_plots(page)[-1]["axes"]
    assert {axis["label"] for axis in axes} == {"tracking mean [m]", "hand jerk [m/s³]"}


@pytest.mark.slow
def test_a_box_around_points_chooses_their_episodes(page, page_file):
    open_plots(page)
    place = list(FIGURES).index("tracking_mean")
    errors = [row[0][place] for row in read_figures(page_file)["rows"]]
    host = page.locator('[data-plot="tracking_mean over episode"]')
    page.mouse.move(*locate(page, host, 2.5, max(errors)))
    page.mouse.down()
    page.mouse.move(*locate(page, host, 4.5, min(errors)), steps=5)
    page.mouse.up()
    page.wait_for_function(
        "() => document.querySelector('#choice').value === 'chosen in the plots'"
    )
    show(page, "episodes")
    assert read_list(page) == ["3", "4"]
    show(page, "plots")
    page.mouse.dblclick(*locate(page, host, 1.5, max(errors)))
    page.wait_for_function("() => document.querySelector('#choice').value === 'all episodes'")


@pytest.mark.slow
@pytest.mark.parametrize("width", [1360, 420])
def test_every_axis_is_labelled_and_whole(page, width):
    page.set_viewport_size({"width": width, "height": 900})
    figures = open_plots(page)
    show(page, "episodes")
    open_timelines(page, 1)
    timeline = "document.querySelector('#episode-1').timeline"
    bands, *panels = page.evaluate(f"({FIGURES_OF})({timeline}.sheet)")
    for figure in (*figures, *panels):
        assert len(figure["axes"]) == 2
        assert all(axis["label"] and axis["inside"] for axis in figure["axes"])
        assert figure["frame"] > 0.7
    assert all(axis["inside"] for axis in bands["axes"])
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_timelines_are_drawn_and_tell_values(page, page_file):
    section = open_timelines(page, 1)
    titles = section.locator(".timeline h4").all_text_contents()
    assert titles == ["Goal and robot", "Command", "Cost by term", "Planner", "Operator"]
    page.wait_for_timeout(200)
    # Something is drawn in every figure.
    drawn = """figures => figures.every((figure) =>
        [...figure.shadowRoot.querySelectorAll("canvas")].some((c) => c.width && c.getContext("2d")
            .getImageData(0, 0, c.width, c.height).data.some((v) => v)))"""
    figures = section.locator(".bk-Figure .bk-Canvas")
    assert figures.count() > 12
    assert figures.evaluate_all(drawn)
    # In the middle of a panel, its legend and those of the others tell the values there.
    panel = section.locator(".panel", has_text="head").nth(2)
    assert panel.locator(".title").inner_text() == "head"
    with Source(page_file.parent / "data") as source:
        names = ["goal.head", "robot.head", "operator.right_wrist"]
        rows = source.read(list(source.episodes)[1], names)
    page.mouse.move(*locate(page, panel.locator("> div").last, FRAMES / 2 / 25, 1.2))
    page.wait_for_function(
        "() => document.querySelector('#episode-1 .clock').textContent.endsWith(' s')"
    )
    told = panel.locator(".legend b").all_inner_texts()
    for text, column, place in ((told[4], "goal.head", 2), (told[5], "robot.head", 2)):
        near = rows[column][FRAMES // 2 - 1 : FRAMES // 2 + 2, place]
        assert float(text) == pytest.approx(near.mean(), abs=0.02)
    other = section.locator(".panel", has_text="operator's right wrist").locator(".legend b").last
    assert float(other.inner_text()) == pytest.approx(
        rows["operator.right_wrist"][FRAMES // 2, 2], abs=0.05
    )


@pytest.mark.slow
def test_curves_are_hidden_and_zoomed_together(page):
    section = open_timelines(page, 1)
    panel = section.locator(".panel", has_text="distance from the goal")
    key = panel.locator(".legend button").first
    timeline = "document.querySelector('#episode-1').timeline"
    key.click()
    assert page.evaluate(f"{timeline}.curves[0].line.visible") is False
    key.click()
    assert page.evaluate(f"{timeline}.curves[0].line.visible") is True
    host = panel.locator("> div").last
    page.mouse.move(*locate(page, host, 1, 0.01))
    page.mouse.down()
    page.mouse.move(*locate(page, host, 2, 0.01), steps=5)
    page.mouse.up()
    ranges = page.evaluate(
        f"{timeline}.sheet.document.roots().map(({{ x_range }}) => [x_range.start, x_range.end])"
    )
    np.testing.assert_allclose(ranges, [(1, 2)] * len(ranges), atol=0.05)
    page.mouse.dblclick(*locate(page, host, 1.5, 0.01))
    page.wait_for_function(f"() => {timeline}.range.start === 0")


def test_what_means_harm_is_text(page):
    open_timelines(page, 0)
    assert page.title() == "Dataset data"
    assert page.problems == []


def test_pictures_and_a_partial_result_of_a_foreign_dataset(browser, foreign, tmp_path, capsys):
    path = tmp_path / "page.html"
    assert main(["report", "--root", str(foreign), "--out", str(path), "--pictures", "5"]) == 0
    assert (
        "left out, for want of columns: goal and robot (no goal.* beside robot.*)"
        in capsys.readouterr().out
    )
    with open_page(browser, path) as page:
        assert "this dataset lacks columns" in page.inner_text("#missing")
        assert page.locator("#episode-0 .strip img").count() == 5
        sizes = page.locator(".strip img").evaluate_all("all => all.map((i) => i.naturalWidth)")
        assert sizes == [32] * 10
        section = page.locator("#episode-0")
        # A click on a picture opens the timelines at its time.
        section.locator("figure").nth(2).click()
        assert section.locator(".clock").inner_text() == "1.40 s"
        assert section.locator("figure.near").count() == 1
        open_timelines(page, 0)
        assert section.locator(".timeline h4").all_text_contents() == ["Command"]
        names = section.locator(".legend button").all_inner_texts()
        assert [name.split()[1] for name in names] == ["a.pos", "b.pos", "c.pos"]
        assert page.problems == []


# Without a browser.


def test_timelines_hold_the_columns(page_file):
    root = page_file.parent / "data"
    timeline = read_timelines(page_file)[1]
    groups = {group["title"]: group["panels"] for group in timeline["groups"]}
    with Source(root) as source:
        entry = list(source.episodes)[1]
        rows = source.read(entry, ["goal.head", "robot.head", "retargeter.cost", "operator.head"])
    head = next(panel for panel in groups["Goal and robot"] if panel["title"] == "head")
    series = {each["name"]: decode(each) for each in head["series"]}
    for place, axis in enumerate("xyz"):
        np.testing.assert_allclose(series[f"{axis} goal"], rows["goal.head"][:, place], atol=1e-4)
        np.testing.assert_allclose(series[axis], rows["robot.head"][:, place], atol=1e-4)
    names = [series["name"] for series in groups["Cost by term"][0]["series"]]
    assert "tracking" in names
    bands = {band["name"]: band["runs"] for band in timeline["bands"]}
    assert bands["left wrist lost"] == [[0.8, 1.8, ""]]
    assert bands["head lost"] == []
    bands = {band["name"]: band["runs"] for band in read_timelines(page_file)[0]["bands"]}
    assert bands["sub-tasks"] == [[0.0, 1.6, "reach"], [1.6, 4.0, "lift"]]


def test_what_is_said_is_what_inspect_says(page_file):
    data = read_figures(page_file)
    assert [figure["name"] for figure in data["figures"]] == list(FIGURES)
    with Source(page_file.parent / "data") as source:
        for row, finding in zip(data["rows"], survey(source), strict=True):
            for value, expected in zip(row[0], finding.figures.values(), strict=True):
                assert value == (pytest.approx(expected) if expected is not None else None)


def test_a_chosen_part(made, tmp_path, capsys):
    path = tmp_path / "page.html"
    flags = ["--root", str(made), "--out", str(path), "--quiet"]
    assert main(["report", *flags, "--episodes", "1,3-5", "--detailed", "2"]) == 0
    text = path.read_text()
    assert [row[0][0] for row in read_figures(path)["rows"]] == [1, 3, 4, 5]
    assert re.findall(r'id="episode-(\d+)"', text) == ["3", "5"]
    assert "Only 4 of 6 episodes" in text
    assert "Images and timelines of 2 of 4 episodes, evenly" in text
    assert main(["report", *flags, "--overwrite", "--episodes", "1,9"]) == 1
    assert capsys.readouterr().err == f"error: dataset '{made}': it has no episode 9 (it has 6)\n"
    assert path.read_text() == text


def test_nothing_is_replaced_unless_asked(made, tmp_path, capsys):
    before = compute_digests(made)
    path = tmp_path / "page.html"
    path.write_text("mine")
    flags = ["report", "--root", str(made)]
    assert main([*flags, "--out", str(path)]) == 2
    said = f"error: '{path}' exists already. Choose another --out, or add --overwrite\n"
    assert capsys.readouterr().err == said
    assert path.read_text() == "mine"
    assert main([*flags, "--out", str(path), "--overwrite"]) == 0
    assert path.read_text().startswith("<!doctype html>")
    assert main([*flags, "--out", str(tmp_path / "new" / "folder")]) == 0
    assert (tmp_path / "new" / "folder" / "index.html").is_file()
    assert main([*flags, "--out", str(made / "page.html")]) == 2
    assert main(flags) == 2
    assert "say where the page goes" in capsys.readouterr().err
    assert main([*flags, "--out", str(tmp_path / "a.html"), "--points", "1"]) == 2
    assert capsys.readouterr().err == "error: --points must be 2 or more, got 1\n"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["new", "page.html"]
    assert compute_digests(made) == before


def test_a_dry_run_writes_nothing(made, tmp_path, capsys):
    flags = ["report", "--root", str(made), "--dry-run", "--detailed", "4"]
    assert main([*flags, "--out", str(tmp_path / "page.html")]) == 0
    assert main(flags) == 0
    assert capsys.readouterr().out == "6 episodes, 4 of them with pictures and timelines\n" * 2
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_read_is_named_and_the_rest_is_shown(foreign, tmp_path, capsys):
    root = Path(shutil.copytree(foreign, tmp_path / "data"))
    video = next(root.rglob("*.mp4"))
    video.write_bytes(video.read_bytes()[:2000])
    path = tmp_path / "page.html"
    assert main(["report", "--root", str(root), "--out", str(path)]) == 1
    assert "2 of 2 episodes cannot be read as a whole; the page says why" in capsys.readouterr().err
    text = path.read_text()
    assert text.count('<p class="problem">videos/observation.images.cam/') >= 2
    assert [len(each["groups"]) for each in read_timelines(path)] == [1, 1]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_dataset(made, tmp_path):
    """What is held after many episodes is what is held after few."""

    def measure(repeats: int) -> int:
        limits = Limits(0, 160, 50)
        with Source(made) as source:
            findings = list(survey(source))
            count = repeats * len(findings)
            path = tmp_path / f"{repeats}.html"
            with Report(path, source, limits, count, count, chosen=False) as report:
                tracemalloc.start()
                for _ in range(repeats):
                    for finding in findings:
                        report.add(finding)
                held, peak = tracemalloc.get_traced_memory()
                tracemalloc.stop()
                report.finish([], [])
        assert len(read_figures(path)["rows"]) == count
        return peak

    measure(1)  # what is imported and kept the first time
    assert measure(12) < measure(3) + 100_000


def test_thinning_keeps_peaks():
    values = np.sin(np.arange(9000) / 500)
    values[4321] = 7
    values[1234:1240] = np.nan
    few = thin(values, 300)
    assert few.shape == (300,)
    assert np.nanmax(few) == 7
    assert np.nanmin(few) == np.nanmin(values)
    assert int(np.nanargmax(few)) in (2 * (4321 * 150 // 9000), 2 * (4321 * 150 // 9000) + 1)
    both = thin(np.stack([values, -values], axis=1), 301)
    assert both.shape == (300, 2)
    np.testing.assert_array_equal(both[:, 0], few)
    np.testing.assert_array_equal(thin(values[:300], 300), values[:300])


@pytest.mark.parametrize("values", [[0.1, -3, 2e5], [5, 5], [], [np.nan, 1, np.inf], [np.nan]])
def test_series_come_back(values):
    values = np.array(values, float)
    back = decode(encode(values))
    known = np.isfinite(values)
    np.testing.assert_array_equal(np.isfinite(back), known)
    span = np.ptp(values[known]) if known.any() else 0
    np.testing.assert_allclose(back[known], values[known], atol=span * 1e-4 + 1e-6)


def test_scripts_hold_any_text():
    text = dump_script({"a": EVIL, "b": "\u2028 ü"})
    assert "<" not in text
    assert json.loads(text) == {"a": EVIL, "b": "\u2028 ü"}


@pytest.mark.slow
@pytest.mark.parametrize("task", ["", "dual_point_touch"])
def test_what_no_task_judged_has_not_failed(browser, tmp_path, task):
    """Without a task and without a mark nothing is red; one episode is shown without a table."""
    root = make_synthetic(tmp_path / "data", 1, 20)
    path = root / CONFIG_FILE
    path.write_text(json.dumps({"robot": {"task": task}}))
    column = root / "data/chunk-000/file-000.parquet"
    kind = pq.read_schema(column).field("next.success").type
    lost = pa.array([False] * 20, kind)
    rewrite(column, {"next.success": lost})
    file = root / EPISODES_FILE
    facts = [{**json.loads(line), "success": False} for line in file.read_text().splitlines()]
    file.write_text("".join(json.dumps(each) + "\n" for each in facts))
    assert main(["report", "--root", str(root), "--out", str(tmp_path / "page.html")]) == 0
    with open_page(browser, tmp_path / "page.html") as page:
        assert page.locator(".mark.failed").first.is_visible() == bool(task)
        assert not page.locator("#bar").is_visible()
        assert not page.locator("#table").is_visible()
        assert not page.locator("#plots").is_visible()
        assert page.locator(".episode h3").is_visible()
        page.locator(".bands .bk-Figure").wait_for()
        assert "20.0 to" not in page.inner_text("#summary")
