"""The tutorials' code runs as it is printed, and writes files that the independent check passes."""

import re
from pathlib import Path

import pytest
from test_audit import load_verify

DOCS = Path(__file__).parents[1] / "docs"
OWN = {"own_constraint": "Wrist(q1,q2), Elbow(q2)", "own_sampler": "Holds(t,force), limits of force"}


@pytest.mark.parametrize("name", OWN)
def test_a_tutorial_runs_from_top_to_bottom(name, tmp_path, monkeypatch, capsys):
    text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert blocks and text.count("```") == 2 * len(blocks)
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"{name}.md, block {number}", "exec"), namespace)
    capsys.readouterr()
    assert load_verify().main(["samples.npz", "--limit", "20"]) == 0
    assert f"not checked here, the file's maker's own: {OWN[name]}\n" in capsys.readouterr().out
