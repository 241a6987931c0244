"""The constraint graph as a picture (paper, Figure 2): variables are circles, constraints squares, columns mode switches.

From top to bottom: rows on poses alone, poses (a grasp between the columns of the hold that it spans), rows that tie
configurations to poses, configurations, rows on configurations alone. A circle holds its variable's degrees of freedom, a
square the constraint's equality rows.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from cgs_jax.errors import InputError
from cgs_jax.graph import ConstraintGraph
from cgs_jax.scene import Task

_RADIUS, _HALF = 21, 11
_SPACE = 78
"""Least distance of two neighbours in a row, px."""
_COLUMN = 124
"""Least width of a column, px."""
_MARGIN = 26
_LEGEND = 300
"""Width of the legend, px; a task of two switches is not wider, and fits on a phone."""
_ROWS = {"above": 66, "pose": 132, "kin": 216, "configuration": 300, "below": 366, "pair": 436}
_HEIGHT = 536
_COLOURS = {"configuration": "#cfe0f3", "pose": "#f6e2bd", "vector": "#dcecd5"}


def describe(graph: ConstraintGraph, task: Task) -> dict[str, Any]:
    """All that is drawn, JSON-ready: switches, variables with the columns that they span, constraints."""
    columns: dict[str, tuple[int, int]] = {}
    for k, switch in enumerate(task.switches):
        columns |= dict.fromkeys(switch.configurations.values(), (k, k))
    columns |= {placement.variable: (task.switch_index(placement.at),) * 2 for placement in task.placements}
    columns |= {hold.variable: task.span(hold) for hold in task.holds}
    for own in [v.name for v in graph.variables if v.name not in columns]:
        # A variable that the task does not know stands among those that it is tied to.
        near = [k for name in graph.neighbours(own) for k in columns.get(name, ())]
        columns[own] = (min(near, default=0), max(near, default=0))
    return {
        "name": graph.name,
        "switches": [switch.name for switch in task.switches],
        "variables": [
            {"name": v.name, "dof": v.dof, "kind": v.kind, "columns": list(columns[v.name])} for v in graph.variables
        ],
        "constraints": [
            {
                "name": c.name,
                "factor": c.factor,
                "scope": list(c.scope),
                "equality_rows": c.equality_rows,
                "inequality_rows": c.inequality_rows,
            }
            for c in graph.constraints
        ],
    }


def draw(described: Mapping[str, Any]) -> str:
    """The graph that `describe` described, as one SVG element."""
    variables, constraints = described["variables"], described["constraints"]
    row_of = {v["name"]: "pose" if v["kind"] == "pose" else "configuration" for v in variables}
    row_of_constraint = {c["name"]: _row(c["scope"], row_of) for c in constraints}
    edges = _column_edges(described, row_of)
    middles = [(left + right) / 2 for left, right in zip(edges[:-1], edges[1:], strict=True)]

    wanted = {v["name"]: sum(middles[k] for k in v["columns"]) / 2 for v in variables}
    x = _placed({v["name"]: wanted[v["name"]] for v in variables if row_of[v["name"]] == "pose"})
    x |= _placed({v["name"]: wanted[v["name"]] for v in variables if row_of[v["name"]] == "configuration"})
    at: dict[str, float] = {}
    for row in ("above", "kin", "below", "pair"):
        mine = [c for c in constraints if row_of_constraint[c["name"]] == row]
        # A row that ties both kinds stands over its configurations: they say when it holds.
        at |= _placed({c["name"]: _mean(x, c["scope"], row_of, row == "kin") for c in mine})

    low = min([edges[0], *(value - _SPACE / 2 for value in (*x.values(), *at.values()))])
    high = max([edges[-1], *(value + _SPACE / 2 for value in (*x.values(), *at.values()))])
    width = max(high - low + 2 * _MARGIN, _LEGEND)
    shift = (width - low - high) / 2
    pairs = any(row == "pair" for row in row_of_constraint.values())
    height = _HEIGHT if pairs else _HEIGHT - (_ROWS["pair"] - _ROWS["below"])
    label = f"Constraint graph of {described['name']}: {len(variables)} variables, {len(constraints)} constraints"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height}" width="{width:.0f}" height="{height}" '
        f'role="img" aria-label={quoteattr(label)} font-family="sans-serif" font-size="12" text-anchor="middle">',
        f"<title>{escape(label)}</title>",
        f'<rect width="{width:.0f}" height="{height}" fill="#ffffff"/>',
    ]
    bottom = height - 60
    for k, name in enumerate(described["switches"]):
        left, right = edges[k] + shift, edges[k + 1] + shift
        parts.append(
            f'<rect x="{left:.1f}" y="8" width="{right - left:.1f}" height="{bottom - 8}" '
            f'fill="{"#f4f5f7" if k % 2 == 0 else "#eaecef"}"/>'
        )
        parts.append(f'<text x="{(left + right) / 2:.1f}" y="28" font-weight="bold" fill="#333333">{escape(name)}</text>')
    for c in constraints:
        top = _ROWS[row_of_constraint[c["name"]]]
        for name in c["scope"]:
            parts.append(
                f'<line x1="{at[c["name"]] + shift:.1f}" y1="{top}" x2="{x[name] + shift:.1f}" y2="{_ROWS[row_of[name]]}" '
                'stroke="#7a828c" stroke-width="1.2"/>'
            )
    for c in constraints:
        parts += _square(c, at[c["name"]] + shift, row_of_constraint[c["name"]])
    for v in variables:
        parts += _circle(v, x[v["name"]] + shift, _ROWS[row_of[v["name"]]])
    parts += _legend(width / 2, bottom + 26)
    return "\n".join([*parts, "</svg>"])


def save(path: Path, described: Mapping[str, Any]) -> None:
    """Writes the picture; the file appears whole or not at all. Raises InputError when it cannot be written."""
    temporary = path.with_name(path.name + f".{os.getpid()}.part")
    try:
        temporary.write_text(draw(described) + "\n", encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None


def _row(scope: Sequence[str], row_of: Mapping[str, str]) -> str:
    rows = {row_of[name] for name in scope}
    if rows == {"pose"}:
        return "above"
    if rows == {"configuration"}:
        return "below" if len(scope) == 1 else "pair"
    return "kin"


def _column_edges(described: Mapping[str, Any], row_of: Mapping[str, str]) -> list[float]:
    """Where columns begin and end: wide enough for the configurations in each."""
    edges = [0.0]
    for k, name in enumerate(described["switches"]):
        mine = [v for v in described["variables"] if row_of[v["name"]] == "configuration" and v["columns"][0] == k]
        edges.append(edges[-1] + max(_COLUMN, len(mine) * _SPACE + 20, 9 * len(name)))
    return edges


def _mean(x: Mapping[str, float], scope: Sequence[str], row_of: Mapping[str, str], configurations: bool) -> float:
    values = [x[name] for name in scope if not configurations or row_of[name] == "configuration"]
    return sum(values) / len(values)


def _placed(wanted: Mapping[str, float]) -> dict[str, float]:
    """Positions in a row, in the wanted order, no two nearer than `_SPACE` and each group centred where it wants to be."""
    groups: list[tuple[list[str], float]] = []
    for name in sorted(wanted, key=wanted.__getitem__):
        groups.append(([name], wanted[name]))
        while len(groups) > 1:
            (before, first), (after, second) = groups[-2:]
            if second - first >= (len(before) + len(after)) / 2 * _SPACE:
                break
            count = len(before) + len(after)
            groups[-2:] = [(before + after, (first * len(before) + second * len(after)) / count)]
    return {
        name: centre + (i - (len(names) - 1) / 2) * _SPACE for names, centre in groups for i, name in enumerate(names)
    }


def _circle(variable: Mapping[str, Any], x: float, y: float) -> list[str]:
    name, dof = variable["name"], variable["dof"]
    size = 13 if len(name) <= 5 else max(7, 13 * 5 / len(name))
    return [
        f'<g><title>{escape(name)}: {escape(variable["kind"])} with {dof} degrees of freedom</title>',
        f'<circle cx="{x:.1f}" cy="{y}" r="{_RADIUS}" fill="{_COLOURS[variable["kind"]]}" stroke="#2c3e50"/>',
        f'<text x="{x:.1f}" y="{y + 2}" font-size="{size:.1f}" fill="#111111">{escape(name)}</text>',
        f'<text x="{x:.1f}" y="{y + 14}" font-size="9" fill="#333333">{dof}</text></g>',
    ]


def _square(constraint: Mapping[str, Any], x: float, row: str) -> list[str]:
    y = _ROWS[row]
    # The label stands where no edge comes in.
    side, below = x + _HALF + 4, y + _HALF + 13
    where = {"above": (x, y - _HALF - 4, "middle"), "kin": (side, y + 4, "start")}.get(row, (x, below, "middle"))
    rows, bounds = constraint["equality_rows"], constraint["inequality_rows"]
    factor = constraint["factor"]
    shown = factor if len(factor) <= 12 else factor[:11] + "…"
    return [
        f"<g><title>{escape(constraint['name'])}: {rows} equality and {bounds} inequality rows</title>",
        f'<rect x="{x - _HALF:.1f}" y="{y - _HALF}" width="{2 * _HALF}" height="{2 * _HALF}" '
        'fill="#3b4652" stroke="#ffffff" stroke-width="1"/>',
        f'<text x="{x:.1f}" y="{y + 4}" font-size="11" fill="#ffffff">{rows or "≤"}</text>',
        f'<text x="{where[0]:.1f}" y="{where[1]}" text-anchor="{where[2]}" font-size="11" fill="#111111" stroke="#ffffff" '
        f'stroke-width="3" paint-order="stroke">{escape(shown)}</text></g>',
    ]


def _legend(x: float, y: float) -> list[str]:
    return [
        f'<text x="{x:.1f}" y="{y + 16 * line - 8}" font-size="11" fill="#555555">{text}</text>'
        for line, text in enumerate(
            (
                "circles: variables and their degrees of freedom",
                "squares: constraints and their equality rows",
                "(≤: inequalities alone)",
            )
        )
    ]
