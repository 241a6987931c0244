"""Settings of all tests: one cache of compiled programs, shared with the commands that tests start."""

import os
from pathlib import Path

from cgs_jax.cache import enable_disk_cache

ROOT = Path(__file__).parents[1]


def pytest_configure(config):
    folder = config.cache.mkdir("compiled")
    # Commands under test keep their programs below XDG_CACHE_HOME; the tests' own process uses the same folder.
    os.environ["XDG_CACHE_HOME"] = str(folder)
    enable_disk_cache()
    # Commands run with the package that is tested, installed or not.
    known = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([known] if known else [])])
