"""The report of a run: its numbers are those of the files, it needs no network, and it fits a phone."""

import base64
import contextlib
import importlib.util
import io
import json
import re
import shutil
import sys
import time
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_viewer import open_browser

from cgs_jax import render, report
from cgs_jax.coverage import Cell, projected_coverage
from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

pytest.importorskip("matplotlib", reason="the extra 'report' is not installed")

ROOT = Path(__file__).parents[1]


def load_script(name):
    spec = importlib.util.spec_from_file_location(f"{name}_command", ROOT / "scripts" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sample, show = load_script("sample"), load_script("show")


class Page(HTMLParser):
    """Tables by id as lists of rows of texts, the facts at the top, and whatever could be fetched."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.facts, self.links, self.images, self.ids = {}, {}, [], [], Counter()
        self._table, self._row, self._cell, self._term, self._tag = None, None, None, None, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.ids.update([attrs["id"]] if "id" in attrs else [])
        self.links += [attrs[name] for name in ("src", "href", "xlink:href", "data", "poster") if name in attrs]
        self.images += [attrs["src"]] if tag == "img" else []
        if tag == "table":
            self._table = self.tables.setdefault(attrs["id"], [])
        elif tag == "tr":
            self._row = []
        elif tag in ("td", "th", "dt", "dd"):
            self._cell, self._tag = "", tag

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._row.append(self._cell)
        elif tag == "tr":
            self._table.append(self._row)
        elif tag == "dt":
            self._term = self._cell
        elif tag == "dd":
            self.facts[self._term] = self._cell
        if tag in ("td", "th", "dt", "dd"):
            self._cell = None


def read(folder):
    return json.loads((folder / "run.json").read_text()), json.loads((folder / "tree.json").read_text())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run with its report."""
    folder = tmp_path_factory.mktemp("report") / "run"
    options = ["--num-samples", "60", "--time-budget", "120", "--diverse", "40", "--quiet", "--report"]
    assert sample.main(["--scene", "pick_place", "--out", str(folder), *options]) == 0
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run" / "report.html").unlink()
    return tmp_path / "run"


@pytest.fixture
def no_pictures(monkeypatch):
    """Leaves the contact sheet out: drawing one takes longest."""

    def none(*_):
        raise InputError("no OpenGL")

    monkeypatch.setattr(render, "contact_sheet", none)


# ------------------------------------------------------------------ what it says


def test_the_numbers_are_those_of_the_files(finished):
    run, tree = read(finished)
    page = Page((finished / "report.html").read_text(encoding="utf-8"))
    assert run["samples"] >= 60 and run["samples_written"] == 40
    assert int(page.facts["samples"]) == run["samples"] and int(page.facts["samples in the file"]) == 40
    assert abs(float(page.facts["samples per second"]) - run["rate"]) <= 0.051
    assert abs(float(page.facts["sampling"].split()[0]) - run["elapsed"]) <= 0.051
    assert int(page.facts["rejected by the audit"]) == run["rejected_by_audit"]

    operators = {row[0]: row for row in page.tables["operators"][1:]}
    assert set(operators) == set(run["operators"])
    for name, entry in run["operators"].items():
        assert int(operators[name][1]) == entry["tasks"]
        assert abs(float(operators[name][2].split()[0]) / 100 - entry["successes"] / entry["tasks"]) < 0.00051
    failures = Counter()
    for entry in run["operators"].values():
        failures.update(entry["failures"])
    told = {row[0]: int(row[1]) for row in page.tables["failures"][1:]}
    assert told == dict(failures) and list(told.values()) == sorted(told.values(), reverse=True)

    nodes = {entry["sequence"]: entry for entry in tree["sequences"] if entry["sequence"]}
    assert len(page.tables["tree"]) - 1 == min(len(nodes), report.TREE_ROWS)
    for text in [text for text in nodes if ";" not in text]:
        (row,) = [row for row in page.tables["tree"][1:] if row[0] == text][:1]
        entry = nodes[text]
        assert float(row[1]) == round(entry["visits"]) and abs(float(row[4]) - entry["q"]) < 0.0051
        assert abs(float(row[2].split()[0]) / 100 - entry["success_rate"]) < 0.00051
    assert [row[0] for row in page.tables["best"][1:]] == [text for text, _ in run["best_sequences"]]
    assert f"Of {run['transitions']['complete']} transitions" in (finished / "report.html").read_text()


def test_coverage_is_that_of_the_samples(finished):
    samples = SampleSet.load(finished)
    rows = Page((finished / "report.html").read_text(encoding="utf-8")).tables["coverage"][1:]
    assert {row[0]: int(row[1]) for row in rows} == projected_coverage(samples, Cell())
    spread = json.loads((finished / "run.json").read_text())["spread"]
    for row in rows:
        if row[0] in spread:
            assert abs(float(row[2].split()[0]) / 100 - spread[row[0]]["limit_share"]) < 0.00051


def test_the_progress_of_the_run_ends_at_its_count(finished):
    run, _ = read(finished)
    seconds, counts = np.array(run["progress"]["seconds"]), np.array(run["progress"]["samples"])
    assert (np.diff(seconds) >= 0).all() and (np.diff(counts) >= 0).all()
    assert (counts[0], counts[-1]) == (0, run["samples"]) and seconds[-1] <= run["elapsed"]
    samples = SampleSet.load(finished)
    for moment in samples.elapsed:
        assert counts[seconds <= moment + 1e-9].max() > 0


def test_every_sample_is_in_the_pair_plots_panels():
    values = np.random.default_rng(0).normal(size=(500, 3))
    text = report._pair_plot("q", ["1", "2", "3"], values)
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(re.search(r"data:image/png;base64,([^\"]*)", text)[1]))))
    assert picture.shape[0] >= 3 * report.BINS and "Pair plot of q" in text
    assert all(f">{label}<" in text for label in "123")


def test_turned_poses_are_shown_from_their_mean():
    angles = np.linspace(-0.4, 0.4, 41)
    poses = np.zeros((41, 7))
    poses[:, 3], poses[:, 6] = np.cos(1.0 + angles / 2), np.sin(1.0 + angles / 2)
    poses[::2, 3:] *= -1  # the same rotations
    labels, columns = report._coordinates(poses, "pose")
    assert labels[3:] == ["rx", "ry", "rz"]
    np.testing.assert_allclose(columns[:, 5], angles, atol=1e-9)
    np.testing.assert_allclose(columns[:, :5], 0, atol=1e-9)


# ------------------------------------------------------------------ self-contained


def test_nothing_is_fetched_and_no_name_is_used_twice(finished):
    text = (finished / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in page.links)
    assert not re.search(r"url\((?!#)|@import|<script|<link|<iframe", text)
    assert "default-src 'none'" in text
    assert [name for name, times in page.ids.items() if times > 1] == []
    assert all(link[1:] in page.ids for link in page.links if link.startswith("#"))
    assert set(re.findall(r"url\(#([^)]*)\)", text)) <= set(page.ids)
    assert str(finished) not in text and len(text) < 4e6
    if page.images:
        sheet = Image.open(io.BytesIO(base64.b64decode(page.images[0].split(",")[1])))
        assert sheet.format == "PNG" and sheet.size[0] > 600


def test_a_later_report_is_the_same(finished, copied, capsys, monkeypatch):
    assert show.main([str(copied), "--report"]) == 0
    assert capsys.readouterr().out.strip() == str(copied / "report.html")
    assert (copied / "report.html").read_bytes() == (finished / "report.html").read_bytes()
    (copied / "report.html").unlink()
    monkeypatch.setattr(render, "contact_sheet", lambda *_: np.zeros((8, 8, 3), np.uint8))
    assert show.main([str(copied / "samples.npz"), "--report"]) == 0 and (copied / "report.html").exists()


def test_names_are_text_and_nothing_else(copied, no_pictures):
    run, tree = read(copied)
    entry = next(iter(run["operators"].values()))
    entry["failures"] = {"<b>&": 10**6}
    page = Page(report.compose(run, tree, None))
    assert page.tables["failures"][1][:2] == ["<b>&", str(10**6)]


# ------------------------------------------------------------------ what may be missing


def test_a_run_without_samples_says_what_stopped_it(copied):
    run, _ = read(copied)
    run |= {"samples": 0, "samples_written": 0, "rate": 0.0, "diagnosis": "operator t succeeded 0 of 9 times", "spread": {}}
    run["progress"] = {"seconds": [0.0], "samples": [0]}
    (copied / "run.json").write_text(json.dumps(run))
    (copied / "samples.npz").unlink()
    text = report.save_report(copied).read_text(encoding="utf-8")
    assert "No sample: operator t succeeded 0 of 9 times" in text and "No sample was found." in text
    assert 'id="failures"' in text and 'id="coverage"' not in text and "Load the samples" not in text


def test_without_opengl_a_sentence_stands_for_the_pictures(copied, no_pictures):
    text = report.save_report(copied).read_text(encoding="utf-8")
    assert "No pictures on this machine: no OpenGL." in text and "<img" not in text


def test_without_matplotlib_one_line_names_the_extra_before_sampling(copied, monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with contextlib.suppress(SystemExit):
        assert sample.main(["--scene", "pick_place", "--report", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert ".[report]" in error and len(error.splitlines()) == 1 and not (tmp_path / "out").exists()
    assert show.main([str(copied), "--report"]) == 2
    assert ".[report]" in capsys.readouterr().err and not (copied / "report.html").exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "run.json").unlink(), "cannot read .*run.json.*expected the folder of a run"),
        (lambda folder: (folder / "tree.json").write_text("{"), "cannot read .*tree.json"),
        (lambda folder: (folder / "run.json").write_text("{}"), "run.json lacks samples, rate"),
        (lambda folder: (folder / "samples.npz").unlink(), "no sample file"),
    ],
)
def test_what_is_no_run_is_told_in_one_line(copied, spoil, said):
    spoil(copied)
    with pytest.raises(InputError, match=said) as error:
        report.save_report(copied)
    assert "\n" not in str(error.value)
    assert not list(copied.glob("report*"))


# ------------------------------------------------------------------ in a browser


def long_tree(tree, depth=9):
    """The tree with a branch of many steps that assign many variables with long names."""
    step = "(" + ",".join(f"q_variable{i}" for i in range(8)) + ")"
    entry = {**tree["sequences"][0], "visits": 1234.0, "success_rate": 1.0, "seconds_per_condition": 1.0, "q": -12.34}
    branch = [{**entry, "sequence": "; ".join([step] * i)} for i in range(1, depth + 1)]
    return {**tree, "sequences": [*tree["sequences"], *branch]}


def test_it_fits_a_phone_and_paper_and_asks_for_nothing(copied):
    _, tree = read(copied)
    (copied / "tree.json").write_text(json.dumps(long_tree(tree)))
    page = report.save_report(copied)
    browser = open_browser()
    try:
        browser.set_page_load_timeout(120)
        for width in (390, 1200):
            screen = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 500}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
            browser.get(page.as_uri())
            end = time.monotonic() + 60
            while browser.execute_script("return document.readyState") != "complete":
                assert time.monotonic() < end, "the page does not load"
                time.sleep(0.05)
            inner, wide, long = browser.execute_script(
                "const d = document.documentElement; return [window.innerWidth, d.scrollWidth, d.scrollHeight]"
            )
            assert inner == width and wide <= width and long > 2000
            beyond = browser.execute_script(
                "return [...document.querySelectorAll('p, dd, table, td, figure, svg, img, pre')].filter("
                "e => !e.closest('.graph svg, .sheet img') && (!e.closest('svg') || e.tagName === 'svg')).filter("
                "e => e.getBoundingClientRect().right > window.innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80))"
            )
            assert beyond == []
            # Nothing of the graph is cut off, and a phone shows the graph of two mode switches whole.
            assert browser.execute_script(
                "const all = [...document.querySelectorAll('.graph svg, .graph svg text')].map(e => e.getBoundingClientRect());"
                "return all.every(box => box.left >= all[0].left && box.right <= Math.min(all[0].right, window.innerWidth))"
            )
            # The words on the contact sheet are for 320 pixels a column.
            sheet = browser.execute_script("return document.querySelector('.sheet img').getBoundingClientRect().width")
            assert sheet / len(SampleSet.load(copied).mode_switches) >= 180
            smallest = browser.execute_script(
                "return Math.min(...[...document.querySelectorAll('p, dd, dt, td, pre')].filter(e => e.offsetParent)"
                ".map(e => parseFloat(getComputedStyle(e).fontSize)))"
            )
            assert smallest >= 12
            asked = browser.execute_script("return performance.getEntriesByType('resource').map(entry => entry.name)")
            assert [name for name in asked if not name.startswith("data:")] == []
            assert browser.execute_script("return [...document.images].every(i => i.complete && i.naturalWidth > 0)")
        assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
        paper = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"]
        assert base64.b64decode(paper).startswith(b"%PDF")
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen | {"width": 690})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 690
        # The sheet, its heading and the line below it go on one page of A4 or Letter: 269 and 251 mm without margins.
        low, high = browser.execute_script(
            "const box = e => e.getBoundingClientRect(), sheet = document.querySelector('.sheet');"
            "return [box(sheet.previousElementSibling).top, box(sheet.nextElementSibling).bottom]"
        )
        assert high - low <= 251 / 25.4 * 96
    finally:
        browser.quit()
