"""The house rules that a reader relies on: who may import whom, what is public, what is said in two places."""

import ast
import re
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

import cgs_jax

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cgs_jax"
MODULES = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")
SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))

# Each module and all that it may know of. Two towers that never import each other: the search, which knows no scene and
# no JAX, and the mathematics, which knows no graph; a thin bridge over both, and the porch.
GRAPH = {"errors", "graph", "transitions", "histories", "uct"}
MATHEMATICS = {
    "poses", "distance", "augmented_lagrangian", "kinematics", "constraints", "collisions", "plans", "seeds", "tables", "costs",
}  # fmt: skip
MAY_IMPORT = {
    # the search
    "errors": set(),
    "graph": {"errors"},
    "transitions": {"errors", "graph"},
    "histories": {"errors", "graph", "transitions"},
    "uct": {"errors", "histories", "transitions"},
    # the mathematics
    "poses": set(),
    "distance": set(),
    "augmented_lagrangian": set(),
    "kinematics": {"errors", "poses"},
    "constraints": {"poses"},
    "collisions": {"constraints", "distance", "kinematics", "poses"},
    "plans": {"augmented_lagrangian", "collisions", "constraints", "distance", "kinematics", "poses"},
    "seeds": {"constraints", "plans", "poses"},
    "tables": {"cache", "constraints", "kinematics", "plans", "poses", "seeds"},
    "costs": {"augmented_lagrangian", "plans", "poses"},
    # scenes, samples and what reads them
    "scene": {"errors"},
    "samples": {"errors"},
    "audit": {"errors", "samples"},
    "coverage": {"errors", "samples"},
    "render": {"errors", "samples"},
    "viewer": {"errors", "render", "samples"},
    "fitting": {"errors"},
    "starter": {"errors", "fitting", "render"},
    # the bridge
    "cache": set(),
    "programs": {"cache"},
    "problems": {"errors", "graph", "transitions", "scene"} | MATHEMATICS,
    "operators": {"errors", "problems", "transitions"} | MATHEMATICS,
    "keyframes": {"constraints", "kinematics", "problems"},
    "own": {"audit", "constraints", "errors", "graph", "problems", "tables"},
    "batches": {
        "audit", "augmented_lagrangian", "keyframes", "operators", "own", "problems", "programs", "scene", "tables",
        "transitions",
    },
    "worker": {"errors", "audit", "batches", "cache", "operators", "problems", "programs", "transitions"},
    "sampler": {
        "errors", "audit", "augmented_lagrangian", "batches", "cache", "keyframes", "operators", "problems", "programs",
        "scene", "transitions", "uct", "worker",
    },
    # the porch
    "diagram": {"errors", "graph", "scene"},
    "report": {"errors", "coverage", "diagram", "render", "samples"},
    "check": {
        "errors", "audit", "constraints", "kinematics", "operators", "plans", "poses", "problems", "scene", "transitions",
    },
    "record": {"audit", "coverage", "diagram", "problems", "sampler", "samples", "scene", "transitions", "uct"},
    "utilisation": {
        "augmented_lagrangian", "operators", "plans", "poses", "problems", "record", "sampler", "seeds", "transitions",
    },
    "api": {
        "errors", "audit", "augmented_lagrangian", "costs", "coverage", "operators", "plans", "poses", "problems", "record",
        "sampler", "samples", "transitions", "uct",
    },
}  # fmt: skip

# Packages that a module may name at its top, beside the standard library; what is not listed may use NumPy, JAX and MuJoCo.
PLAIN = {"errors": set(), "graph": set(), "transitions": set(), "histories": set(), "uct": set()}
HOST = {
    "scene": {"numpy", "mujoco"},
    "samples": {"numpy"},
    "audit": {"numpy", "mujoco"},
    "coverage": {"numpy", "scipy"},
    "render": {"numpy", "mujoco", "PIL"},
    "viewer": {"numpy", "mujoco", "viser", "glfw"},
    "fitting": {"numpy", "mujoco", "scipy"},
    "starter": {"numpy", "mujoco"},
    "record": {"numpy"},
    "report": {"numpy", "scipy", "matplotlib", "PIL"},
}

# Modules that scripts may read names from, beside `cgs_jax` itself: the homes of the public names and what is loaded on demand.
DOORS = {
    *cgs_jax._HOMES.values(),
    *("coverage", "diagram", "experiments", "fitting", "record", "render", "report", "starter", "utilisation", "viewer"),
}

# The benchmark also asks the workers for their memory.
MEASURES_PARTS = {"benchmark": {"worker"}}


@cache
def imports(path):
    """(imported module, names or None) of every import anywhere in a file, relative ones made absolute."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = "cgs_jax." if node.level else ""
            found.append((package + (node.module or ""), tuple(alias.name for alias in node.names)))
    return found


def modules_of_ours(path):
    """Modules of the package that a file imports."""
    found = set()
    for module, names in imports(path):
        if module.rstrip(".") == "cgs_jax":
            found |= {name for name in names or () if name in MODULES}
        elif module.startswith("cgs_jax."):
            found.add(module.split(".")[1])
    return found


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_one_way(module):
    assert module in MAY_IMPORT, f"say in this table what {module} may import"
    assert modules_of_ours(PACKAGE / f"{module}.py") <= MAY_IMPORT[module]


def test_the_towers_do_not_know_each_other():
    assert not any(MAY_IMPORT[module] & MATHEMATICS for module in GRAPH)
    assert not any(MAY_IMPORT[module] & (GRAPH - {"errors"}) for module in MATHEMATICS)


def test_the_table_has_no_circle():
    remaining = dict(MAY_IMPORT)
    while remaining:
        ready = [module for module, known in remaining.items() if not known & remaining.keys()]
        assert ready, f"a circle among {sorted(remaining)}"
        for module in ready:
            del remaining[module]


@pytest.mark.parametrize("module", sorted(PLAIN | HOST))
def test_what_needs_no_jax_imports_none(module):
    packages = {name.split(".")[0] for name, _ in imports(PACKAGE / f"{module}.py")}
    assert packages - sys.stdlib_module_names - {"cgs_jax"} <= (PLAIN | HOST)[module]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_use_public_names(script):
    doors = DOORS | MEASURES_PARTS.get(script.stem, set())
    for module, names in imports(script):
        if module == "cgs_jax":
            for name in names or ():
                assert name in cgs_jax.__all__ or name in doors, f"{name} is not public"
        elif module.startswith("cgs_jax."):
            assert module.split(".")[1] in doors, f"{module} is not public"
            assert not any(name.startswith("_") for name in names or ())
    if script.stem == "verify":
        assert not modules_of_ours(script), "the independent check shares no code with the package"


def test_every_public_name_exists():
    for name in cgs_jax.__all__:
        assert getattr(cgs_jax, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = cgs_jax.nonsense


def test_no_module_knows_a_scene():
    scenes = {path.stem for path in (ROOT / "scenes").glob("*/*.toml")}
    assert {"banana", "handover", "pick_place"} <= scenes
    for module in set(MODULES) - {"problems"}:
        for node in ast.walk(ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare):
                words = {part.value for part in ast.walk(node) if isinstance(part, ast.Constant)}
                assert not words & scenes, f"{module}.py line {node.lineno} compares with a scene's name"


def test_there_is_no_drawer_for_everything():
    for name in ("utils", "util", "helpers", "common", "misc"):
        assert name not in MODULES


# ------------------------------------------------------------------ what is said in two places agrees


def code_lines(text):
    """Lines of the shell blocks of a Markdown text."""
    blocks = re.findall(r"```(?:sh|bash|console)\n(.*?)```", text, flags=re.S)
    return [line for block in blocks for line in block.splitlines()]


def test_ci_runs_the_readmes_test_line():
    (line,) = [line for line in code_lines((ROOT / "README.md").read_text()) if "pytest" in line]
    assert line in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_api_page_tells_every_public_name():
    told = re.findall(r"\*\*`(\w+)", (ROOT / "docs" / "api.md").read_text())
    assert sorted(set(told)) == cgs_jax.__all__


def normalised(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    texts = project["build-system"]["requires"] + project["project"]["dependencies"]
    texts += project["project"]["optional-dependencies"]["test"]
    return {normalised(re.split(r"[\[<>=~! ]", text)[0]) for text in texts}


def test_ci_has_an_exact_version_of_everything_that_is_asked_for():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    assert requirements() <= {normalised(line.split("==")[0]) for line in lines}


def test_every_dependency_is_used():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    used = {name.split(".")[0] for path in PACKAGE.rglob("*.py") for name, _ in imports(path)}
    used |= {name.split(".")[0] for path in SCRIPTS for name, _ in imports(path)}
    used |= {name for path in PACKAGE.glob("*.py") for _, names in imports(path) for name in names or () if name == "mjx"}
    module_of = {"pillow": "PIL", "mujoco-mjx": "mjx"}
    for text in project["dependencies"]:
        name = re.split(r"[<>=~! ]", text)[0]
        assert module_of.get(name, name) in used, f"no code uses {name}"
