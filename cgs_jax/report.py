"""One page per run: `report.html`, self-contained, for a screen, a phone and paper.

Everything on the page is read from the files that the run wrote (run.json, tree.json, samples.npz), so that a later report
of the same run says the same. Plots are inline SVG by matplotlib (extra `report`), the contact sheet is an embedded PNG.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax import diagram
from cgs_jax.coverage import Cell, projected_coverage
from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

TREE_ROWS = 40
"""Nodes of the tree that are shown at most, those with the most visits."""

PLOTTED = 4000
"""Samples in a pair plot at most."""

SHOWN = 6
"""Samples on the contact sheet."""

BINS = 28
"""Cells along each side of a panel of a pair plot."""

_READ = ("samples", "rate", "elapsed", "operators", "transitions", "spread", "progress", "graph", "best_sequences")


def require_plots() -> None:
    """Raises InputError where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError('a report needs the package matplotlib, install it with: pip install -e ".[report]"')


def save_report(folder: str | os.PathLike[str]) -> Path:
    """Writes `report.html` into the folder of a run, beside its files; it appears whole or not at all. Returns its path.

    Raises InputError when the folder holds no run, a file is damaged, or matplotlib is not installed.
    """
    require_plots()
    folder = Path(folder)
    run, tree = _read(folder / "run.json"), _read(folder / "tree.json")
    missing = [key for key in _READ if key not in run]
    if missing:
        raise InputError(f"{folder / 'run.json'} lacks {', '.join(missing)}, expected the run.json of a run")
    samples = SampleSet.load(folder) if run.get("samples_written") else None
    target = folder / "report.html"
    temporary = folder / f"report.html.{os.getpid()}.part"
    try:
        temporary.write_text(compose(run, tree, samples), encoding="utf-8")
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return target


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"cannot read {path}: {reason}; expected the folder of a run") from None
    if not isinstance(data, dict):
        raise InputError(f"{path} holds no table, expected the file of a run")
    return data


def compose(run: Mapping[str, Any], tree: Mapping[str, Any], samples: SampleSet | None) -> str:
    """The page as HTML text."""
    title = f"{run['scene']}, instance {run['instance']}"
    parts = [
        _head(run, title),
        _section("Constraint graph", _graph(run)),
        _section("Samples over time", _over_time(run)),
        _section("The tree", _tree(tree)),
        _section("Operators", _operators(run)),
        _section("Failures per constraint", _failures(run)),
    ]
    if samples is not None and len(samples):
        parts += [
            _section("Coverage per variable", _coverage(run, samples)),
            _section("Pair plots", _pair_plots(samples)),
            _section("Contact sheet", _contact_sheet(samples)),
            _section("Load the samples", _loading(samples)),
        ]
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        # Nothing may be fetched: what is not in this file does not exist.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "style-src 'unsafe-inline'; img-src data:\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{_STYLE}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: #1b1f23; font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: 0.5rem 0 0; }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #d0d7de; }
h3 { font-size: 1rem; margin: 1rem 0 0.25rem; }
p { margin: 0.4rem 0; overflow-wrap: break-word; }
.faint { color: #57606a; font-size: 0.9rem; }
.fault { border-left: 4px solid #b42318; padding: 0.4rem 0.8rem; background: #fdf1ef; }
dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: 0.6rem; margin: 1rem 0; }
dl div { border: 1px solid #d0d7de; border-radius: 4px; padding: 0.4rem 0.6rem; }
dt { color: #57606a; font-size: 0.8rem; }
dd { margin: 0; font-weight: 600; overflow-wrap: anywhere; }
figure { margin: 0.5rem 0; }
svg, img { max-width: 100%; height: auto; display: block; }
.pairs { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(26rem, 100%), 1fr)); gap: 1rem; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; margin: 0.5rem 0; }
th, td { padding: 0.2rem 0.5rem; text-align: right; vertical-align: top; border-bottom: 1px solid #eaeef2; }
th { color: #57606a; font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; overflow-wrap: break-word; }
.step { display: block; padding-left: calc(var(--depth) * 0.8em); overflow-wrap: anywhere; }
.bar { display: block; height: 0.35rem; background: #2f6fab; min-width: 1px; margin-left: auto; }
pre { background: #f6f8fa; padding: 0.6rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: 0.85rem; }
@media (max-width: 40rem) {
  main { padding: 0.75rem; }
  table.stacked thead { display: none; }
  table.stacked tr { display: block; padding: 0.4rem 0; border-bottom: 1px solid #d0d7de; }
  table.stacked td { display: flex; justify-content: space-between; gap: 1rem; }
  table.stacked td { border: 0; padding: 0.05rem 0; text-align: right; }
  table.stacked td:first-child { font-weight: 600; }
  table.stacked td:not(:first-child)::before { content: attr(data-label); color: #57606a; text-align: left; }
  th, td { padding: 0.2rem; }
  #tree { table-layout: fixed; font-size: 0.8rem; }
  #tree th:first-child { width: 34%; }
  #tree th:nth-child(3) { width: 19%; }
  .graph, .sheet { overflow-x: auto; }
  .sheet img { max-width: none; width: max(100%, calc(var(--columns) * 15rem)); }
  .graph svg { max-width: none; }
  .step { padding-left: calc(var(--depth) * 0.4em); }
}
@media print {
  @page { margin: 14mm; }
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  h2, h3 { break-after: avoid; }
  figure, tr, dl, pre, .fault { break-inside: avoid; }
  thead { display: table-header-group; }
  .bar { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  .pairs { grid-template-columns: 1fr 1fr; }
  .faint { break-before: avoid; }
  /* A page of Letter paper holds the sheet with its heading and the line below it. */
  img { max-height: 220mm; }
}
"""


# ------------------------------------------------------------------ pieces of a page


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>"


def _table(name: str, columns: Sequence[str], rows: Iterable[Sequence[str]], stacked: bool = False) -> str:
    """A table of HTML cells; stacked: on a narrow screen each row becomes a block of its own."""
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = []
    for row in rows:
        cells = "".join(f'<td data-label="{escape(c)}">{cell}</td>' for c, cell in zip(columns, row, strict=True))
        lines.append(f"<tr>{cells}</tr>")
    style = ' class="stacked"' if stacked else ""
    return f'<table id="{name}"{style}>\n<thead><tr>{head}</tr></thead>\n<tbody>\n' + "\n".join(lines) + "\n</tbody>\n</table>"


def _name(text: str) -> str:
    """Names and sequences as HTML that may break after a comma."""
    return escape(text).replace(",", ",<wbr>")


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}\N{NARROW NO-BREAK SPACE}%"


def _bar(share: float) -> str:
    return f'<span class="bar" style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></span>'


def _head(run: Mapping[str, Any], title: str) -> str:
    facts = {
        "samples": f"{run['samples']}",
        "samples per second": f"{run['rate']:.1f}",
        "sampling": f"{run['elapsed']:.1f} s",
        "before sampling": f"{run['startup_seconds']:.1f} s",
        "compiling, partly beside": f"{run['compile_seconds']:.1f} s",
        "rejected by the audit": f"{run['rejected_by_audit']}",
        "samples in the file": f"{run['samples_written']}",
        "method": str(run["method"]),
        "seed": f"{run['seed']}",
        "ended by": str(run["ended_by"]),
    }
    entries = "\n".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts.items())
    versions = ", ".join(f"{name} {number}" for name, number in run["versions"].items() if number)
    fault = f'<p class="fault">No sample: {escape(run["diagnosis"])}</p>\n' if run.get("diagnosis") else ""
    return f'<h1>{escape(title)}</h1>\n<dl id="facts">\n{entries}\n</dl>\n{fault}<p class="faint">{escape(versions)}</p>'


def _graph(run: Mapping[str, Any]) -> str:
    counts = run["transitions"]
    kept = f"<p>Of {counts['complete']} transitions between sets of assigned variables, {counts['pruned']} are kept.</p>"
    return f'<figure class="graph">{diagram.draw(run["graph"])}</figure>\n{kept}'


def _over_time(run: Mapping[str, Any]) -> str:
    seconds, counts = (np.asarray(run["progress"][key], dtype=float) for key in ("seconds", "samples"))
    best = _table("best", ["best sequences", "predicted /s"], [(_name(t), f"{r:.0f}") for t, r in run["best_sequences"]])
    if not run["samples"]:
        return "<p>No sample was found.</p>"
    edges = np.linspace(0.0, max(run["elapsed"], seconds[-1]), 41)
    found = np.interp(edges, seconds, counts, right=counts[-1])
    figure, (rate, total) = _figure(5.4, 4.2, 2)
    rate.stairs(np.diff(found) / np.diff(edges), edges, color="#2f6fab", linewidth=1.4)
    rate.axhline(run["rate"], color="#7a828c", linewidth=0.9, linestyle=":")
    rate.set(ylabel="samples per second", ylim=(0, None), xlim=(0, edges[-1]))
    total.plot(np.append(seconds, edges[-1]), np.append(counts, counts[-1]), color="#2f6fab", linewidth=1.4)
    total.set(ylabel="samples", xlabel="seconds of sampling", ylim=(0, None), xlim=(0, edges[-1]))
    picture = _svg(figure, "rate", "Samples per second and samples over time")
    return f"<figure>{picture}</figure>\n<p class=\"faint\">Dotted: the mean over the run.</p>\n{best}"


def _tree(tree: Mapping[str, Any]) -> str:
    """The nodes with the most visits and all above them, each below its parent."""
    nodes = {entry["sequence"]: entry for entry in tree["sequences"] if entry["sequence"]}
    most = sorted(nodes, key=lambda text: -nodes[text]["visits"])[:TREE_ROWS]
    shown = {text for text in most} | {above for text in most for above in _above(text) if above in nodes}
    if not shown:
        return "<p>No operator ran.</p>"
    total = max(nodes[text]["visits"] for text in shown)
    has_value = any("q" in entry for entry in nodes.values())
    rows = []

    def show(parent: str) -> None:
        children = [text for text in shown if _parent(text, shown) == parent]
        for text in sorted(children, key=lambda child: -nodes[child]["visits"]):
            entry = nodes[text]
            step = text[len(parent) + 2 :] if parent else text
            depth = len(_above(text))
            label = f'<span class="step" style="--depth:{depth}">{_name(step)}</span>'
            per = entry["seconds_per_condition"]
            row = [label, f"{entry['visits']:.0f}{_bar(entry['visits'] / total)}", _percent(entry["success_rate"])]
            row.append("–" if per is None else f"{1e6 * per:.0f}")
            rows.append(row + ([f"{entry['q']:.2f}"] if has_value else []))
            show(text)

    show("")
    left = len(nodes) - len(shown)
    columns = ["assigned next", "visits", "success", "µs each", *(["value"] if has_value else [])]
    note = "Visits are batches. Success and device time are per condition; recent batches weigh more. " + (
        "The value is the tree's Q: finished samples that a condition leads to, less its time at the price of the run's rate. "
        if has_value
        else ""
    )
    more = f"{left} more nodes with fewer visits are not shown." if left else ""
    return _table("tree", columns, rows) + f'\n<p class="faint">{note}{more}</p>'


def _above(sequence: str) -> list[str]:
    """All proper prefixes of a sequence, the shortest first."""
    steps = sequence.split("; ")
    return ["; ".join(steps[:i]) for i in range(1, len(steps))]


def _parent(sequence: str, shown: set[str]) -> str:
    """The longest prefix that is shown, or nothing."""
    return next((text for text in reversed(_above(sequence)) if text in shown), "")


def _operators(run: Mapping[str, Any]) -> str:
    rows = []
    for name, entry in run["operators"].items():
        worst = list(entry["failures"])[:2]
        rows.append(
            (
                _name(name),
                str(entry["tasks"]),
                _percent(entry["success_rate"]),
                _percent(entry["condition_feasible"]),
                _percent(entry["solver_success_if_feasible"]),
                f"{entry['microseconds_per_task']:.0f}",
                _name(", ".join(worst) or "–"),
            )
        )
    columns = ("new | given", "tasks", "success", "condition feasible", "solver on those", "µs per task", "stopped by")
    return _table("operators", columns, rows, stacked=True)


def _failures(run: Mapping[str, Any]) -> str:
    counts: Counter[str] = Counter()
    for entry in run["operators"].values():
        counts.update(entry["failures"])
    total = sum(counts.values())
    if not total:
        return "<p>No task failed.</p>"
    rows = [
        (_name(name), f"{count}{_bar(count / max(counts.values()))}", _percent(count / total))
        for name, count in counts.most_common()
    ]
    return _table("failures", ("constraint", "tasks it stopped", "share"), rows)


def _coverage(run: Mapping[str, Any], samples: SampleSet) -> str:
    """Occupied cells of each variable as samples come in, and at the end."""
    cell = Cell()
    ordered = samples.select(np.argsort(samples.elapsed, kind="stable"))
    sizes = sorted({math.ceil(len(samples) * part) for part in np.linspace(0.0, 1.0, 17)[1:]})
    curves: list[Any] = [projected_coverage(ordered.select(slice(0, size)), cell) for size in sizes]
    figure, (axes,) = _figure(5.4, 3.2, 1)
    for name in samples.variables:
        axes.plot([0, *sizes], [0, *(curve[name] for curve in curves)], linewidth=1.4, label=name)
    axes.set(xlabel="samples", ylabel="occupied cells", xlim=(0, len(samples)), ylim=(0, None))
    axes.legend(loc="upper left", ncols=2, fontsize=9)
    rows = []
    for name, count in curves[-1].items():
        spread = run["spread"].get(name, {})
        rows.append((escape(name), str(count), _percent(spread.get("limit_share")), _percent(spread.get("duplicate_share"))))
    table = _table("coverage", ("variable", "occupied cells", "samples at a joint limit", "near-duplicates"), rows)
    note = f"A cell is {cell.joint:g} rad or m per joint; {cell.position:g} m and {cell.rotation:g} rad of a pose."
    return f'<figure>{_svg(figure, "coverage", "Occupied cells over samples")}</figure>\n{table}\n<p class="faint">{note}</p>'


def _pair_plots(samples: SampleSet) -> str:
    chosen = np.linspace(0, len(samples) - 1, min(len(samples), PLOTTED)).round().astype(int)
    figures = []
    for name, values in samples.variables.items():
        labels, columns = _coordinates(values[chosen], samples.kinds[name])
        moving = np.ptp(columns, axis=0) > 1e-4
        fixed = [label for label, moves in zip(labels, moving, strict=True) if not moves]
        note = f'<p class="faint">Without spread: {escape(", ".join(fixed))}.</p>' if fixed else ""
        picture = ""
        if moving.any():
            kept = [label for label, moves in zip(labels, moving, strict=True) if moves]
            picture = f"<figure>{_pair_plot(name, kept, columns[:, moving])}</figure>"
        figures.append(f"<div><h3>{escape(name)}</h3>{picture}{note}</div>")
    note = (
        f"{len(chosen)} of {len(samples)} samples. Joints in rad or m; of poses the position in m and the rotation vector from "
        "the mean rotation in rad. On the diagonal the share of samples by value; below an axis, its range."
    )
    return f'<div class="pairs">\n{chr(10).join(figures)}\n</div>\n<p class="faint">{note}</p>'


def _coordinates(values: NDArray[np.float64], kind: str) -> tuple[list[str], NDArray[np.float64]]:
    """Names and columns that are plotted: joints, or position and rotation vector."""
    if kind != "pose":
        return [f"{i + 1}" for i in range(values.shape[1])], values
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_quat(values[:, [4, 5, 6, 3]])
    return ["x", "y", "z", "rx", "ry", "rz"], np.concatenate([values[:, :3], (turns * turns.mean().inv()).as_rotvec()], axis=1)


def _pair_plot(name: str, labels: Sequence[str], columns: NDArray[np.float64]) -> str:
    """Density of every pair of columns in one picture of panels, histograms on the diagonal."""
    count = len(labels)
    side = BINS + 2
    picture = np.full((count * side, count * side), np.nan)
    low, high = columns.min(axis=0), columns.max(axis=0)
    cells = np.clip(((columns - low) / (high - low) * BINS).astype(int), 0, BINS - 1)
    for i in range(count):
        for j in range(i + 1):
            if i == j:
                heights = np.bincount(cells[:, i], minlength=BINS)
                filled = np.arange(BINS)[:, None] < (heights / heights.max() * (BINS - 1)).round()
                panel = np.where(filled, 0.6, 0.0)
            else:
                panel = np.zeros((BINS, BINS))
                np.add.at(panel, (cells[:, i], cells[:, j]), 1.0)
                panel = np.sqrt(panel / panel.max())
            picture[i * side + 1 : i * side + 1 + BINS, j * side + 1 : j * side + 1 + BINS] = panel[::-1]
    size = min(1.4 + 0.8 * count, 5.0)
    figure, (axes,) = _figure(size, size, 1)
    axes.imshow(picture, cmap="Blues", vmin=0.0, vmax=1.0, interpolation="nearest")
    middles = np.arange(count) * side + side / 2 - 0.5
    ranges = [f"{label}\n{a:.2g}\n{b:.2g}" for label, a, b in zip(labels, low, high, strict=True)]
    axes.set_xticks(middles, ranges, fontsize=9)
    axes.set_yticks(middles, labels, fontsize=9)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    return _svg(figure, f"pairs-{name}", f"Pair plot of {name}")


def _contact_sheet(samples: SampleSet) -> str:
    try:
        from cgs_jax import render

        picture = render.contact_sheet(samples, samples.diverse(SHOWN).tolist())
    # A MUJOCO_GL that cannot be had stops MuJoCo's import with whatever the missing library leads to.
    except (InputError, ImportError, RuntimeError, AttributeError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return f'<p id="no-sheet">No pictures on this machine: {escape(reason)}.</p>'
    from PIL import Image

    buffer = io.BytesIO()
    few = Image.fromarray(picture).quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(buffer, "PNG", optimize=True)
    text = f"Samples that differ most, one row each; columns: {', '.join(samples.mode_switches)}"
    source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    columns = len(samples.mode_switches)
    image = f'<img alt="{escape(text)}" src="{source}">'
    return f'<figure class="sheet" style="--columns:{columns}">{image}</figure>\n<p class="faint">{escape(text)}.</p>'


def _loading(samples: SampleSet) -> str:
    name = next(iter(samples.variables))
    width = samples[name].shape[1]
    count, switches, length = samples.qpos.shape
    ours = (
        "import cgs_jax\n\n"
        'samples = cgs_jax.SampleSet.load("samples.npz")\n'
        f'samples["{name}"]     # ({count}, {width})\n'
        f"samples.qpos         # ({count}, {switches}, {length}) MuJoCo configurations: {', '.join(samples.mode_switches)}\n"
        "samples.diverse(10)  # positions of the ten that differ most\n"
    )
    plain = (
        "import mujoco\nimport numpy as np\n\n"
        'stored = np.load("samples.npz")\n'
        'model = mujoco.MjModel.from_xml_string(str(stored["mjcf"]))\n'
        "data = mujoco.MjData(model)\n"
        'data.qpos[:] = stored["qpos"][0, -1]\n'
        "mujoco.mj_forward(model, data)\n"
    )
    commands = "python scripts/verify.py samples.npz\npython scripts/show.py samples.npz --view\n"
    blocks = (("With this package", ours), ("With NumPy and MuJoCo alone", plain), ("Check them, look at them", commands))
    return "\n".join(f"<h3>{title}</h3>\n<pre>{escape(text)}</pre>" for title, text in blocks)


# ------------------------------------------------------------------ plots


def _figure(width: float, height: float, rows: int) -> tuple[Any, list[Any]]:
    """A matplotlib figure with axes below each other; sizes in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = [figure.add_subplot(rows, 1, i + 1) for i in range(rows)]
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(color="#e6e6e6")
        each.set_axisbelow(True)
    return figure, axes


def _svg(figure: Any, name: str, label: str) -> str:
    """The figure as an SVG element whose text stays text and whose names are its own."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "font.family": "sans-serif"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    prefix = re.sub(r"[^\w-]", "-", name)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}-", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1)
