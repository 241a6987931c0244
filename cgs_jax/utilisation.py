"""How much of the machine a run used: useful lane-iterations, and the solver's arithmetic over what a matrix product reaches.

The float operations of a solver's step are counted in its jaxpr as written, with loops followed; seeds, clearance and audit are
not counted.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from cgs_jax import augmented_lagrangian as al
from cgs_jax.operators import Operator, operator_of
from cgs_jax.plans import PlanSystem
from cgs_jax.poses import Pose, from_vector
from cgs_jax.problems import Problem, with_collisions
from cgs_jax.seeds import count_draws, draw, uniforms
from cgs_jax.transitions import Transition

if TYPE_CHECKING:
    from cgs_jax.record import Recorder
    from cgs_jax.sampler import SamplerSettings

LEAST_SHARE = 0.01
"""Of the device time: operators with less are left out."""


def utilisation(record: Recorder) -> dict[str, Any]:
    """Of a run that is over: by operator and in all, useful lane-iterations over those that ran, and FLOP/s over the peak.

    Takes a second or two per operator, and two for the peak, measured now. FLOP/s are over the whole sampling time, with
    steps of idle lanes; ready for JSON.
    """
    settings, operators = record.settings, {}
    problem = with_collisions(record.problem, settings.collisions)
    useful = executed = flops = 0.0
    for name, entry in record.operators.items():
        if not entry.executed or entry.device_seconds < LEAST_SHARE * record.device_seconds:
            continue
        per_step = flops_per_lane_step(problem, record.transitions[name], settings)
        operators[name] = {
            "flops_per_lane_step": per_step,
            "useful_share": entry.iterations / entry.executed,
            "iterations": entry.iterations,
            "iterations_per_task": entry.iterations / entry.tasks,
            "device_seconds": entry.device_seconds,
            "achieved_flops": entry.executed * per_step / entry.device_seconds,
        }
        useful += entry.iterations
        executed += entry.executed
        flops += entry.executed * per_step
    peak = peak_of_machine()
    share = useful / executed if executed else 0.0
    covered = sum(row["device_seconds"] for row in operators.values())
    per_second = flops / record.elapsed if record.elapsed else 0.0
    return {
        "operators": operators,
        "share_of_device_time_counted": covered / record.device_seconds if record.device_seconds else 0.0,
        "useful_lane_iterations": useful,
        "lane_iterations": executed,
        "useful_share": share,
        "flops": per_second,
        "useful_flops": per_second * share,
        "peak_flops": peak,
        "share_of_peak": per_second / peak,
        "flops_per_sample": flops / record.count if record.count else None,
    }


def flops_per_lane_step(problem: Problem, transition: Transition, settings: SamplerSettings) -> float:
    """Float operations of one solver iteration of one lane; work that does not depend on the lane is shared by all."""
    system, state, data = _started(problem, transition, settings)
    leaves, structure = jax.tree.flatten((state, data))

    def step(*parts: jax.Array) -> Any:
        state, data = jax.tree.unflatten(structure, parts)
        return al.step(system, state, data, settings.solver)

    return count_flops(step, *map(jnp.asarray, leaves)) / settings.lanes


def seconds_per_lane_step(problem: Problem, transition: Transition, settings: SamplerSettings) -> float:
    """Seconds of one solver iteration of one lane with nothing else beside it. Compiles."""
    system, state, data = _started(problem, transition, settings)

    @jax.jit
    def steps(count: jax.Array, state: Any, data: Any) -> Any:
        return jax.lax.fori_loop(0, count, lambda _, s: al.step(system, s, data, settings.solver), state)

    repeats, times = 50, []
    for _ in range(6):
        began = time.perf_counter()
        jax.block_until_ready(steps(jnp.int32(repeats), state, data))
        times.append(time.perf_counter() - began)
    return min(times[1:]) / (repeats * settings.lanes)


def _started(problem: Problem, transition: Transition, settings: SamplerSettings) -> tuple[PlanSystem, Any, Any]:
    """The system of an operator, the state of its solver on one seed per lane, and the data."""
    operator = operator_of(problem, transition)
    x, tasks, shared = _drawn(operator, problem, settings.lanes)
    system = PlanSystem(operator.plan.layout)
    return system, al.init(system, x, (tasks, shared), settings.solver), (tasks, shared)


def _drawn(operator: Operator, problem: Problem, lanes: int) -> tuple[Any, Any, Any]:
    """Seeds, task data and shared data of an operator, with identity poses as what it is given."""
    layout = operator.plan.layout
    numbers = jax.tree.map(jnp.asarray, operator.numbers(problem.params))
    identity = jnp.array([0, 0, 0, 1, 0, 0, 0], jnp.float32)
    pose = from_vector(jnp.broadcast_to(identity[:, None, None], (7, layout.given, lanes)))
    pose = Pose(jnp.moveaxis(pose.rotation, 2, 0), jnp.moveaxis(pose.position, 1, 0))
    q = tuple(jnp.zeros((problem.dofs[name], lanes), jnp.float32) for name in operator.plan.given_configurations)
    u = uniforms(jax.random.key(0), jnp.arange(lanes, dtype=jnp.uint32), count_draws(layout))
    seeds, tasks = draw(layout, pose, q, numbers.tables, numbers.seeds, numbers.choices, numbers.shared, u)
    return seeds, tasks, numbers.shared


_SINGLE = frozenset(
    "add sub mul div max min neg abs sqrt rsqrt sin cos tan exp log log1p expm1 pow integer_pow atan2 asin acos atan tanh "
    "square floor ceil round sign clamp select_n add_any".split()
)
"""Primitives counted as one operation per element of a float result."""

_REDUCTIONS = frozenset("reduce_sum reduce_max reduce_min reduce_prod cumsum cumprod argmax argmin".split())
"""Primitives counted as one operation per element of a float argument."""


def count_flops(function: Callable, *arguments: Any) -> int:
    """Float operations of a jax function of arrays, as it is written: its jaxpr is walked, loops run their full length.

    Only integers and truth values are computed on the way; they must decide how long loops run. A multiplication by a
    constant zero counts; what the compiler then removes or repeats is unknown to this count. Raises TypeError where a float
    decides about a loop or a branch.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    total = 0

    def run(jaxpr: Any, constants: Sequence[Any], values: Sequence[Any]) -> list[Any]:
        """The outputs; None for those that are not known."""
        nonlocal total
        known = dict(zip(jaxpr.constvars, constants, strict=True)) | dict(zip(jaxpr.invars, values, strict=True))

        def read(atom: Any) -> Any:
            value = atom.val if hasattr(atom, "val") else known[atom]
            return value if _discrete(atom) else None

        for equation in jaxpr.eqns:
            inputs = [read(atom) for atom in equation.invars]
            name, parameters = equation.primitive.name, equation.params
            if name == "while":
                outputs = loop(parameters, inputs)
            elif name == "scan":
                outputs = scan(parameters, inputs)
            elif name == "cond":
                if inputs[0] is None:
                    raise TypeError("a float decides about a branch")
                branch = parameters["branches"][int(inputs[0])]
                outputs = run(branch.jaxpr, branch.consts, inputs[1:])
            elif inner := next((parameters[key] for key in ("jaxpr", "call_jaxpr") if key in parameters), None):
                outputs = run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
            elif any(value is None for value in inputs) or not all(map(_discrete, equation.outvars)):
                outputs = [None] * len(equation.outvars)
                total += _operations(name, parameters, equation)
            else:
                outputs = equation.primitive.bind(*inputs, **parameters)
                outputs = outputs if equation.primitive.multiple_results else [outputs]
            known.update(zip(equation.outvars, outputs, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def loop(parameters: Mapping[str, Any], inputs: list[Any]) -> list[Any]:
        test, body = parameters["cond_jaxpr"], parameters["body_jaxpr"]
        first, second = parameters["cond_nconsts"], parameters["body_nconsts"]
        of_test, of_body, carry = inputs[:first], inputs[first : first + second], inputs[first + second :]
        while True:
            (goes_on,) = run(test.jaxpr, test.consts, [*of_test, *carry])
            if goes_on is None:
                raise TypeError("a float decides how long a loop runs")
            if not goes_on:
                return carry
            carry = run(body.jaxpr, body.consts, [*of_body, *carry])

    def scan(parameters: Mapping[str, Any], inputs: list[Any]) -> list[Any]:
        body, fixed, carried = parameters["jaxpr"], parameters["num_consts"], parameters["num_carry"]
        constants, carry, rows = inputs[:fixed], inputs[fixed : fixed + carried], inputs[fixed + carried :]
        turns = range(parameters["length"])
        stacked: list[list[Any]] = [[] for _ in body.jaxpr.outvars[carried:]]
        for i in reversed(turns) if parameters["reverse"] else turns:
            outputs = run(body.jaxpr, body.consts, [*constants, *carry, *(None if row is None else row[i] for row in rows)])
            carry = outputs[:carried]
            for parts, output in zip(stacked, outputs[carried:], strict=True):
                parts.insert(0 if parameters["reverse"] else len(parts), output)
        whole = [None if any(part is None for part in parts) else jnp.stack(parts) for parts in stacked]
        return [*carry, *whole]

    run(closed.jaxpr, closed.consts, arguments)
    return total


def _discrete(variable: Any) -> bool:
    """Whether a variable of a jaxpr holds integers or truth values."""
    kind = getattr(variable.aval, "dtype", None)
    return kind is not None and (np.issubdtype(kind, np.integer) or np.issubdtype(kind, np.bool_))


def _operations(name: str, parameters: Mapping[str, Any], equation: Any) -> int:
    """Float operations of one equation of a jaxpr without loops."""
    result = equation.outvars[0].aval if equation.outvars else None
    if result is None or not np.issubdtype(getattr(result, "dtype", None), np.floating):
        return 0
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        left = equation.invars[0].aval.shape
        return 2 * int(np.prod(result.shape)) * int(np.prod([left[axis] for axis in contracted]))
    if name in _REDUCTIONS:
        return int(np.prod(equation.invars[0].aval.shape))
    return int(np.prod(result.shape)) if name in _SINGLE else 0


def peak_of_machine() -> float:
    """`peak_flops` in a process of its own, which may use all cores whatever this one has set for itself."""
    held = ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in held}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, "-c", "from cgs_jax.utilisation import peak_flops; print(peak_flops())"]
    # Ctrl-C is for this process, which finishes its files first.
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, start_new_session=True)
    return float(done.stdout)


def peak_flops(size: int = 2048, seconds: float = 1.0) -> float:
    """Float operations per second of a plain float32 matrix product on all cores, the best of what jax and numpy reach."""
    left = np.random.default_rng(0).normal(size=(size, size)).astype(np.float32)
    on_device = jnp.asarray(left)
    product = jax.jit(lambda a: a @ a)
    best = 0.0
    for multiply in (lambda: product(on_device).block_until_ready(), lambda: left @ left):
        multiply()
        until = time.perf_counter() + seconds
        while time.perf_counter() < until:
            began = time.perf_counter()
            multiply()
            best = max(best, 2.0 * size**3 / (time.perf_counter() - began))
    return best
