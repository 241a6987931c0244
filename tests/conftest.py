"""Settings of all tests: one cache of compiled programs, shared with the commands that tests start."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]


def pytest_configure(config):
    folder = config.cache.mkdir("compiled")
    # Commands under test keep their programs below XDG_CACHE_HOME; the tests' own process uses the same folder.
    os.environ["XDG_CACHE_HOME"] = str(folder)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "cgs_jax")
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(512 * 2**20)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    # Commands run with the package that is tested, installed or not.
    known = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([known] if known else [])])
