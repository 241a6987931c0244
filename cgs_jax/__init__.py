"""Batched samplers for constraint graphs of sequential manipulation, learned per problem.

    problem = cgs_jax.load_problem("handover", instance=3)
    result = cgs_jax.sample(problem, time_budget=10.0)

Names are loaded when they are first used, so that `import cgs_jax` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "InputError": "errors",
    "Problem": "problems",
    "Run": "api",
    "SampleSet": "samples",
    "Sampler": "sampler",
    "SamplerSettings": "sampler",
    "Tolerances": "audit",
    "available_scenes": "scene",
    "check_problem": "check",
    "enable_disk_cache": "cache",
    "end_process": "programs",
    "load_problem": "problems",
    "load_tree": "api",
    "make_chooser": "api",
    "operator": "api",
    "rollout": "api",
    "sample": "api",
    "stream": "api",
    "with_constraint": "own",
    "with_sampler": "own",
    "with_variable": "own",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cgs_jax' has no attribute '{name}'")
    return getattr(importlib.import_module(f"cgs_jax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
