"""What several test files share: the scenes' problems, loaded once."""

import functools

from cgs_jax import problems

SCENES = ("pick_place", "handover", "banana")


@functools.cache
def problem(name, instance=0):
    return problems.load_problem(name, instance)
