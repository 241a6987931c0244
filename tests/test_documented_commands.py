"""Every shell and Python block of the pages runs, in a folder of its own, with short budgets."""

import functools
import importlib.util
import json
import logging
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp

import made_up
import pytest

from cgs_jax import cache, render
from cgs_jax.errors import InputError
from cgs_jax.experiments import study

ROOT = Path(__file__).parents[1]

# Pages with tests of their own.
TESTED_APART = {"own_constraint.md", "own_robot.md", "own_sampler.md", "own_scene.md"}
PAGES = [
    path
    for path in (ROOT / "README.md", ROOT / "scenes" / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if path.name not in TESTED_APART
]

# What is appended to a command; the last one of an option counts.
SHORTENED = {
    "scripts/sample.py": ["--num-samples", "2", "--time-budget", "60", "--quiet"],
    "scripts/show.py": ["--samples", "diverse:1", "--size", "160x120", "--hold-only"],
    "scripts/verify.py": [],
}

# Appended to a study; last ones count.
MADE_UP_STUDY = ["--seconds", "1", "--seeds", "1", "--instances", "2"]

# Words of commands in the running text that stand for others.
STANDS_FOR = {"NAME": "pick_place"}

# Commands that are not run, and why.
NOT_RUN = {
    "pip": "installs; .ci/run does it in a fresh environment",
    "pytest": "runs this test",
}

# A program that runs once, made with little optimisation.
JITTED = "jax.jit(draw, static_argnums=2"
JIT = {JITTED + ")": JITTED + ", compiler_options={'xla_backend_optimization_level': 0})"}

# Budgets and sizes in Python blocks, as written and as run here.
REWRITTEN = {
    "README.md": {
        "time_budget=10.0, seed=0": "time_budget=60.0, num_samples=10, seed=0",
        "time_budget=10.0)": "time_budget=60.0, num_samples=10)",
        "problem.params, 256)": "problem.params, 8)",
        **JIT,
    },
    "api.md": {"coverage_gain=0.5": "coverage_gain=0.9", **JIT},
}

# From where a page imports JAX, for functions of its own, JAX keeps what it compiles; the package's cache has its programs.
CACHED_JIT = """
import jax
from jax.experimental.compilation_cache import compilation_cache
jax.config.update("jax_compilation_cache_dir", {cache!r})
compilation_cache.reset_cache()
"""


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), flags=re.M | re.S)


def commands(path):
    """The commands of a page, each as its words."""
    lines = [line for block in blocks(path, "sh") for line in block.splitlines()]
    for line in lines:
        words = shlex.split(line, comments=True)
        while "&&" in words:
            yield words[: words.index("&&")]
            words = words[words.index("&&") + 1 :]
        if words:
            yield words


def commands_in_the_text(path):
    """Commands between single backquotes."""
    for text in re.findall(r"`(python\s+scripts/[^`]+)`", path.read_text(encoding="utf-8")):
        yield [STANDS_FOR.get(word, word) for word in shlex.split(text)]


def load_script(path):
    spec = importlib.util.spec_from_file_location(f"documented_{Path(path).stem}", ROOT / path)
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_there_is_no_block_that_nobody_runs():
    """Languages that are shown only are named here; everything else is `sh` or `python`."""
    assert {path.name for path in PAGES} >= {"README.md", "idea.md", "gallery.md", "api.md", "errors.md", "performance.md"}
    for path in PAGES:
        opened = re.findall(r"^```(\w*)\n(?:.*?)^```", path.read_text(encoding="utf-8"), flags=re.M | re.S)
        assert set(opened) <= {"sh", "python", "toml", "bibtex", ""}, path
        for block in blocks(path, ""):
            assert not re.search(r"^(python|pip|import) ", block, flags=re.M), f"{path}: a block that should be sh or python"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_within_the_repository_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8")):
        known = target.startswith("https://") or Path(target).name in TESTED_APART
        assert known or (path.parent / target).exists(), target


def test_pictures_are_small():
    for path in (ROOT / "docs" / "images").iterdir():
        assert path.stat().st_size < {".png": 150_000, ".gif": 800_000}[path.suffix], path.name


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder from which the commands find what they name."""
    for name in ("scripts", "scenes"):
        (tmp_path / name).symlink_to(ROOT / name)
    # A copy: some commands write there.
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    for name in ("old.json", "new.json"):
        shutil.copy(ROOT / "docs" / "results" / "throughput.json", tmp_path / name)
    # The task file of the user's own that scenes/README.md speaks of.
    shutil.copytree(ROOT / "scenes" / "pick_place", tmp_path / "my_scene")
    (tmp_path / "my_scene" / "pick_place.toml").rename(tmp_path / "my_scene" / "my_scene.toml")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def start(*arguments):
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, (arguments, done.stdout + done.stderr)


# Commands that measure for minutes or hours are run up to the measurement and from it on: figures that are committed or made
# up stand in for what was measured. test_benchmark.py and test_reproduce.py measure.


def benchmark(arguments, monkeypatch):
    """`scripts/benchmark.py` with the committed figures for those of its parts that are run."""
    module = load_script("scripts/benchmark.py")
    committed = {}
    for path in sorted((ROOT / "docs" / "results").glob("*.json")):
        committed |= json.loads(path.read_text(encoding="utf-8"))["parts"]
    parts = {name: (lambda given, name=name: dict(committed[name]), tables) for name, (_, tables) in module.PARTS.items()}
    monkeypatch.setattr(module, "PARTS", parts)
    return module.main(arguments)


STUDIES = set()
"""Arguments of the studies that were rehearsed already."""


def reproduce(arguments, monkeypatch):
    """`scripts/reproduce.py` with made-up runs, in a folder of its own; once for all pages that name another folder."""
    if "--out" in arguments:
        at = arguments.index("--out")
        arguments = arguments[:at] + arguments[at + 2 :]
    if tuple(arguments) in STUDIES:
        return 0
    STUDIES.add(tuple(arguments))
    monkeypatch.setattr(study, "execute", functools.partial(made_up.run, scale=0.2))
    monkeypatch.setattr(study, "execute_in_turns", functools.partial(made_up.run_in_turns, scale=0.2))
    monkeypatch.setattr(study, "prepare", lambda problem, settings: iter(()))
    monkeypatch.setattr(study, "keep", lambda count: None)
    return load_script("scripts/reproduce.py").main([*arguments, *MADE_UP_STUDY, "--out", mkdtemp(dir=".")])


REHEARSED = {"scripts/benchmark.py": benchmark, "scripts/reproduce.py": reproduce}


def run(words, monkeypatch):
    program = words[0]
    if program in NOT_RUN:
        return
    assert program == "python", f"{words}: nothing is said here of {program}"
    script, arguments = words[1], [str(Path(word).expanduser()) for word in words[2:]]
    if script in REHEARSED:
        # What a command sets for its process is put back.
        with monkeypatch.context() as patch:
            patch.setattr(cache, "_folder", cache.cache_folder())
            patch.setattr(logging.root.manager, "disable", logging.root.manager.disable)
            assert REHEARSED[script](arguments, patch) == 0, words
        return
    if script == "scripts/show.py" or "--render" in arguments:
        try:
            render.backend()
        except InputError as error:
            pytest.skip(str(error))
    start(script, *arguments, *SHORTENED[script])


@pytest.mark.parametrize("path", [path for path in PAGES if blocks(path, "sh")], ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_a_page_run(path, elsewhere, monkeypatch):
    for words in commands(path):
        run(words, monkeypatch)


def test_commands_in_the_text_run(elsewhere, monkeypatch):
    found = {tuple(words): None for path in PAGES for words in commands_in_the_text(path)}
    assert found
    for words in found:
        run(list(words), monkeypatch)


@pytest.mark.parametrize("path", [path for path in PAGES if blocks(path, "python")], ids=lambda path: path.name)
def test_python_of_a_page_runs(path, elsewhere, pytestconfig):
    """The blocks in order, in one process, with programs from the tests' cache."""
    text = "\n".join(blocks(path, "python"))
    for written, short in REWRITTEN[path.name].items():
        assert written in text, f"{path.name} does not say {written}: take it out of the table"
        text = text.replace(written, short)
    cache = pytestconfig.cache.mkdir("jitted")
    text = text.replace("import jax\n", CACHED_JIT.format(cache=str(cache)))
    (elsewhere / "page.py").write_text(f"import cgs_jax\ncgs_jax.enable_disk_cache()\n{text}\ncgs_jax.end_process(0)\n")
    start("page.py")
