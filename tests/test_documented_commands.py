"""Every shell and Python block of the pages runs, in a folder of its own, with short budgets."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cgs_jax import render
from cgs_jax.errors import InputError

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

# Commands of which only the arguments are read, by which function, and why.
ONLY_PARSED = {
    "scripts/benchmark.py": ("parse", "measures for minutes; test_benchmark.py runs its parts"),
    "scripts/reproduce.py": ("parser", "runs for hours; test_reproduce.py runs a small study"),
}

# Commands that are not run, and why.
NOT_RUN = {
    "pip": "installs; .ci/run does it in a fresh environment",
    "pytest": "runs this test",
}

# Budgets and sizes in Python blocks, as written and as run here.
REWRITTEN = {
    "README.md": {
        "time_budget=10.0, seed=0": "time_budget=60.0, num_samples=10, seed=0",
        "time_budget=10.0)": "time_budget=60.0, num_samples=10)",
        "problem.params, 256)": "problem.params, 8)",
    },
    "api.md": {"coverage_gain=0.5": "coverage_gain=0.9"},
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
    for name in ("scripts", "scenes", "docs"):
        (tmp_path / name).symlink_to(ROOT / name)
    # The task file of the user's own that scenes/README.md speaks of.
    shutil.copytree(ROOT / "scenes" / "pick_place", tmp_path / "my_scene")
    (tmp_path / "my_scene" / "pick_place.toml").rename(tmp_path / "my_scene" / "my_scene.toml")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def start(*arguments):
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, (arguments, done.stdout + done.stderr)


def run(words):
    program = words[0]
    if program in NOT_RUN:
        return
    assert program == "python", f"{words}: nothing is said here of {program}"
    script, arguments = words[1], [str(Path(word).expanduser()) for word in words[2:]]
    if script in ONLY_PARSED:
        module = load_script(script)
        getattr(module, ONLY_PARSED[script][0])().parse_args(arguments)
        return
    if script == "scripts/show.py" or "--render" in arguments:
        try:
            render.backend()
        except InputError as error:
            pytest.skip(str(error))
    start(script, *arguments, *SHORTENED[script])


@pytest.mark.parametrize("path", [path for path in PAGES if blocks(path, "sh")], ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_a_page_run(path, elsewhere):
    for words in commands(path):
        run(words)


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
