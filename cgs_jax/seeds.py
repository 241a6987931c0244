"""Random seeds: where projections start from.

Every lane's stream is a function of seed, operator and task number alone. Free poses are drawn from the constraint on them
alone (grasp, region), in closed form; a user's vectors are uniform within their limits. A configuration is the best of a few
candidates by the residual of the rows that it completes: candidates come from a table of random configurations with their tool
poses, so that judging one costs products of poses and no kinematics. A part of the lanes ignores the table and starts anywhere
within the joint limits, so that every feasible point keeps a positive density. What a user's own samplers draw takes the place
of all this.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cgs_jax.constraints import Form
from cgs_jax.plans import Layout, Point, Shared, Tasks, Words, all_atoms, tools_at
from cgs_jax.poses import Array, Pose, compose, from_quaternion, from_vector, inverse, matmul, matvec, rotation_exp, transpose

CANDIDATES = 16
"""Table entries that a configuration is chosen from."""
JITTER = 0.1
"""Half width, relative to the joint's range, of the uniform offset from a table entry."""
ANYWHERE = 0.125
"""Share of lanes whose configuration starts uniformly in the joint limits."""
LIMIT_SLACK = 0.04
"""Largest part of a joint's range by which a lane's own limits are narrower than the robot's, so that no two lanes clip at
the same value."""


class Tables(NamedTuple):
    """Random configurations, per new configuration, and the poses of its tools there; T entries each."""

    configurations: Array  # (K, joints, T)
    low: Array  # (K, joints) joint limits
    high: Array  # (K, joints)
    rotation: Array  # (tools, 3, 3, T) in the chain's root frame
    position: Array  # (tools, 3, T)


class PoseSeed(NamedTuple):
    """How a pose that satisfies its own constraint is drawn; stacked on the last axis where there are several.

    The draw is `Pose(before * flip * spin, u)` with u uniform within bounds, after a touch site if there is one, inverted for
    grasps (a grasp constrains T_object_gripper and the variable is T_gripper_object).
    """

    low: Array  # (3,) m
    high: Array  # (3,)
    before: Array  # (3, 3)
    axis: Array  # (3,) of the spin
    spins: Array  # () 1: any spin about the axis
    flip: Array  # (3,) axis of a half turn that is made or not; zero: never
    anywhere: Array  # () 1: any rotation
    inverts: Array  # () 1: the variable is the inverse of the draw
    site: Array  # () int32 atom of the touch site in front, 0 for none


class SiteChoices(NamedTuple):
    """Touch sites offered, per site atom: poses `T_object_site`, and how many."""

    poses: Array  # (sites, most, 7)
    count: Array  # (sites,) int32


def pose_seed(form: Form | None, low=(0.0, 0.0, 0.0), high=(0.0, 0.0, 0.0), wanted=None, axes=(), site: int = 0) -> PoseSeed:
    """The seed of a form (see `constraints`); None: positions within a metre of the origin, any rotation.

    Two-finger rows have a closed form when they say that one gripper axis is perpendicular to two object axes; otherwise the
    rotation is drawn from all rotations and the solver does the rest.
    """
    eye, zero = np.eye(3), np.zeros(3)
    before, axis, spins, flip, anywhere = eye, eye[2], 1.0, zero, 0.0
    if form is None:
        low, high, anywhere = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 1.0
    elif form == "touch":
        before = np.diag([1.0, -1.0, -1.0])
    elif form == "oriented":
        before, spins = np.asarray(wanted, dtype=float), 0.0
    elif form == "located":
        anywhere = 1.0
    elif form == "two_finger":
        normal = np.cross(axes[0][1], axes[1][1]) if len(axes) == 2 else zero
        shared = len(axes) == 2 and np.allclose(axes[0][0], axes[1][0]) and axes[0][2] == axes[1][2] == 0.0
        if shared and np.linalg.norm(normal) > 1e-6:
            axis = np.asarray(axes[0][0], dtype=float)
            before = _frame_of(normal / np.linalg.norm(normal)) @ _frame_of(axis).T
            flip = _frame_of(axis)[:, 0]
        else:
            anywhere = 1.0
    return PoseSeed(
        low=np.asarray(low, dtype=float),
        high=np.asarray(high, dtype=float),
        before=before,
        axis=axis,
        spins=np.asarray(spins),
        flip=flip,
        anywhere=np.asarray(anywhere),
        inverts=np.asarray(float(form in ("touch", "two_finger"))),
        site=np.asarray(site, np.int32),
    )


def _frame_of(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z axis is `axis`."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def draw_pose(seed: PoseSeed, site: Pose, u: jax.Array) -> Pose:
    """A pose from its seed; `u` is `(7, lanes)` uniform, `site` the identity where there is none."""
    low, high = jnp.asarray(seed.low)[:, None], jnp.asarray(seed.high)[:, None]
    zero = jnp.zeros((3, 1))
    spin = rotation_exp(jnp.asarray(seed.axis)[:, None] * (2 * jnp.pi * u[0] * seed.spins))
    flip = rotation_exp(jnp.asarray(seed.flip)[:, None] * jnp.where(u[1] < 0.5, 0.0, jnp.pi))
    aligned = compose(Pose(jnp.asarray(seed.before)[..., None], zero), compose(Pose(flip, zero), Pose(spin, zero))).rotation
    rotation = jnp.where(seed.anywhere > 0.5, _any_rotation(u[1:4]), aligned)
    drawn = compose(site, Pose(rotation, low + (high - low) * u[4:7]))
    back = inverse(drawn)
    return jax.tree.map(lambda a, b: jnp.where(seed.inverts > 0.5, a, b), back, drawn)


def _any_rotation(u: jax.Array) -> jax.Array:
    """Uniform rotations `(3, 3, lanes)` from three uniform numbers (Shoemake 1992)."""
    a, b = jnp.sqrt(1 - u[0]), jnp.sqrt(u[0])
    s, t = 2 * jnp.pi * u[1], 2 * jnp.pi * u[2]
    return from_quaternion(jnp.stack([a * jnp.sin(s), a * jnp.cos(s), b * jnp.sin(t), b * jnp.cos(t)]))


def uniforms(key: jax.Array, numbers: jax.Array, count: int) -> jax.Array:
    """Uniform numbers in [0, 1), `(count, lanes)`: a stream per task number `(lanes,)`, whatever the batch."""

    def stream(number: jax.Array) -> jax.Array:
        return jax.random.uniform(jax.random.fold_in(key, number), (count,))

    return jax.vmap(stream, out_axes=1)(numbers)


def count_draws(layout: Layout) -> int:
    """Random numbers per task that `draw` takes."""
    return 2 + layout.sites + 7 * layout.free + layout.configurations * (2 + 2 * layout.joints)


def draw(
    layout: Layout,
    given: Pose,
    given_configurations: tuple[Array, ...],
    tables: Tables,
    seeds: PoseSeed,
    choices: SiteChoices,
    shared: Shared,
    u: jax.Array,
    own: Mapping[str, jax.Array] = MappingProxyType({}),
) -> tuple[Point, Tasks]:
    """Seeds and task data for one chunk of lanes.

    `given` has the poses of the given atoms, `(given, 3, 3, lanes)`; `u` is `(count_draws(layout), lanes)`; `own` has what a
    user's samplers drew (`draw_own`), which takes the place of our own seeds.
    """
    lanes = u.shape[1]
    taken = 0

    def take(count: int) -> jax.Array:
        nonlocal taken
        taken += count
        return u[taken - count : taken]

    slack = take(2)
    if layout.sites:
        pick = take(layout.sites)
        count = jnp.asarray(choices.count)[:, None]
        chosen = jnp.minimum((pick * count).astype(jnp.int32), count - 1)
        for name, (kind, at, _) in _own_places(layout):
            if kind == "free":
                site = jnp.asarray(seeds.site)[at] - layout.first_site
                chosen = jnp.where(jnp.arange(layout.sites)[:, None] == site, _nearest_site(choices, site, own[name]), chosen)
        vectors = jnp.take_along_axis(jnp.asarray(choices.poses), chosen[..., None], axis=1)  # (sites, lanes, 7)
        sites = from_vector(jnp.moveaxis(vectors, 2, 0))
        given = Pose(
            jnp.concatenate([given.rotation, jnp.moveaxis(sites.rotation, 2, 0)]),
            jnp.concatenate([given.position, jnp.moveaxis(sites.position, 1, 0)]),
        )
    free = _draw_free(layout, given, seeds, [take(7) for _ in range(layout.free)], lanes)
    for name, (kind, at, _) in _own_places(layout):
        if kind == "free":
            free = jax.tree.map(lambda all_, one, at=at: all_.at[at].set(one), free, _own_pose(own[name]))
    if not layout.configurations:
        none = jnp.zeros((0, 0, lanes))
        return Point(none, free), Tasks(given, none, none, slack, given_configurations)

    low, high = jnp.asarray(tables.low)[..., None], jnp.asarray(tables.high)[..., None]
    shape = (layout.configurations, layout.joints, lanes)
    pick, wander = take(layout.configurations), take(layout.configurations)[:, None]
    offset = take(layout.configurations * layout.joints).reshape(shape)
    narrow = take(layout.configurations * layout.joints).reshape(shape)
    fixed = {
        at: _inside(own[name], low[at, :dof], high[at, :dof], layout.joints)
        for name, (kind, at, dof) in _own_places(layout)
        if kind == "configuration"
    }
    q = _choose(layout, given, free, tables, shared, pick, fixed)
    q = q + (2.0 * offset - 1.0) * JITTER * (high - low)
    q = jnp.where(wander < ANYWHERE, low + offset * (high - low), q)
    lower = low + LIMIT_SLACK * narrow * (high - low)
    upper = high - LIMIT_SLACK * (1.0 - narrow) * (high - low)
    # A vector's seed is uniform, a user's own is its own: their limits make room for it.
    exact = fixed | {
        at: jnp.clip(low[at] + offset[at] * (high - low)[at], low[at], high[at])
        for at in layout.vectors
        if at not in fixed
    }
    for at, value in exact.items():
        q = q.at[at].set(value)
        lower = lower.at[at].min(value)
        upper = upper.at[at].max(value)
    return Point(jnp.clip(q, lower, upper), free), Tasks(given, lower, upper, slack, given_configurations)


SAMPLER_STREAM = 2**31
"""First number of the streams of a user's samplers in a task's stream; further than any count of uniform numbers."""

LIMIT_ROUNDING = 1e-6
"""Rounding (relative to the limits) that a user's value may lie outside its limits."""


def draw_own(
    layout: Layout, key: jax.Array, numbers: jax.Array, given: jax.Array, configurations: tuple[jax.Array, ...]
) -> dict[str, jax.Array]:
    """What a user's samplers draw, `(dim, lanes)` by variable; each sees what those before it drew.

    `numbers` `(lanes,)` are the tasks' numbers, `given` the vectors of the given atoms `(7, given, lanes)`, `configurations`
    the given ones that functions read, `(dof, lanes)` each.
    """
    drawn: dict[str, jax.Array] = {}
    for at, slot in enumerate(layout.samplers):

        def value_of(name: str, kind: str, index: int) -> jax.Array:
            if kind == "drawn":
                return drawn[name]
            return given[:, index] if kind == "pose" else configurations[index]

        read = {
            name: value_of(name, kind, index)
            for name, (kind, index, _) in zip(slot.sampler.given, slot.arguments, strict=True)
        }

        def one_lane(number: jax.Array, point: dict[str, jax.Array]) -> dict[str, jax.Array]:
            stream = jax.random.fold_in(jax.random.fold_in(key, number), SAMPLER_STREAM + at)
            return slot.sampler.draw(stream, point)

        drawn |= jax.vmap(one_lane, in_axes=(0, -1), out_axes=-1)(numbers, read)
    return drawn


def _own_places(layout: Layout) -> list[tuple[str, tuple[str, int, int]]]:
    """Variables that a user's samplers draw, and where they are."""
    return [place for slot in layout.samplers for place in zip(slot.sampler.variables, slot.results, strict=True)]


def _own_pose(vector: jax.Array) -> Pose:
    """A pose of a user's `(7, lanes)`, whose quaternion may be of any length."""
    length = jnp.sqrt(jnp.sum(jnp.square(vector[3:]), axis=0))
    return from_vector(jnp.concatenate([vector[:3], vector[3:] / length]))


def _inside(value: jax.Array, low: jax.Array, high: jax.Array, joints: int) -> jax.Array:
    """A user's value `(dof, lanes)` padded to `(joints, lanes)`; not a number, so that the task fails, outside the limits."""
    room = LIMIT_ROUNDING * jnp.maximum(1.0, jnp.maximum(jnp.abs(low), jnp.abs(high)))
    within = jnp.all((value >= low - room) & (value <= high + room), axis=0)
    value = jnp.where(within, jnp.clip(value, low, high), jnp.nan)
    return jnp.pad(value, ((0, joints - value.shape[0]), (0, 0)))


def _nearest_site(choices: SiteChoices, site: jax.Array, held: jax.Array) -> jax.Array:
    """The touch site `(lanes,)` of a site atom that is nearest to the gripper of poses `T_gripper_object` `(7, lanes)`."""
    origin = inverse(_own_pose(held)).position
    at = jnp.maximum(site, 0)
    offered = jnp.asarray(choices.poses)[at, :, :3]
    away = jnp.sum(jnp.square(offered[:, :, None] - origin[None]), axis=1)
    away = jnp.where(jnp.arange(offered.shape[0])[:, None] < jnp.asarray(choices.count)[at], away, jnp.inf)
    return jnp.argmin(away, axis=0).astype(jnp.int32)


def _draw_free(layout: Layout, given: Pose, seeds: PoseSeed, draws: list[jax.Array], lanes: int) -> Pose:
    if not layout.free:
        return Pose(jnp.zeros((0, 3, 3, lanes)), jnp.zeros((0, 3, lanes)))
    eye = jnp.broadcast_to(jnp.eye(3)[None, ..., None], (1, 3, 3, lanes))
    in_front = Pose(
        jnp.concatenate([eye, given.rotation]), jnp.concatenate([jnp.zeros((1, 3, lanes)), given.position])
    )
    poses = []
    for f, u in enumerate(draws):
        seed = PoseSeed(*(jnp.asarray(part)[..., f] for part in seeds))
        poses.append(draw_pose(seed, Pose(in_front.rotation[seed.site], in_front.position[seed.site]), u))
    return Pose(jnp.stack([p.rotation for p in poses]), jnp.stack([p.position for p in poses]))


def _fetch(table: jax.Array, start: jax.Array) -> jax.Array:
    """`CANDIDATES` consecutive entries from `start` `(lanes,)` of a table `(rows, T)`: `(rows, lanes, candidates)`.

    A loop of slices: XLA's CPU gather goes element by element.
    """
    wrapped = jnp.concatenate([table, table[:, :CANDIDATES]], axis=1)

    def copy(lane: jax.Array, out: jax.Array) -> jax.Array:
        block = lax.dynamic_slice_in_dim(wrapped, start[lane], CANDIDATES, axis=1)
        return lax.dynamic_update_index_in_dim(out, block, lane, 1)

    return lax.fori_loop(0, start.shape[0], copy, jnp.zeros((table.shape[0], start.shape[0], CANDIDATES), table.dtype))


def _around(
    words: Words, word: jax.Array, first: jax.Array, count: int, atoms: Pose
) -> tuple[Pose, Pose, jax.Array, jax.Array]:
    """A word as before * tool * after for the tool atoms `first` to `first + count - 1`.

    Returns both products `(3, 3, lanes)`, the tool's number (-1: it does not occur) and whether it is inverted. A second
    occurrence counts as the identity: this is a score, not a constraint.
    """
    lanes = atoms.position.shape[-1]
    one = Pose(jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, lanes)), jnp.zeros((3, lanes)))

    def multiply(i: jax.Array, state: tuple) -> tuple:
        before, after, tool, flipped = state
        index, flips = words.atom[word, i], words.inverted[word, i]
        hit = (index >= first) & (index < first + count)
        factor = Pose(
            lax.dynamic_index_in_dim(atoms.rotation, jnp.where(hit, 0, index), 0, keepdims=False),
            lax.dynamic_index_in_dim(atoms.position, jnp.where(hit, 0, index), 0, keepdims=False),
        )
        turn = jnp.where(flips, transpose(factor.rotation), factor.rotation)
        factor = Pose(turn, jnp.where(flips, -matvec(turn, factor.position), factor.position))
        product = compose(jax.tree.map(lambda a, b: jnp.where(tool < 0, a, b), before, after), factor)
        before = jax.tree.map(lambda new, old: jnp.where(tool < 0, new, old), product, before)
        after = jax.tree.map(lambda new, old: jnp.where(tool < 0, old, new), product, after)
        flipped = jnp.where(hit & (tool < 0), flips, flipped)
        tool = jnp.where(hit & (tool < 0), index - first, tool)
        return before, after, tool, flipped

    start = (one, one, jnp.asarray(-1, jnp.int32), jnp.asarray(False))
    return lax.fori_loop(0, words.length, multiply, start)


def _choose(
    layout: Layout,
    given: Pose,
    free: Pose,
    tables: Tables,
    shared: Shared,
    pick: jax.Array,
    fixed: Mapping[int, jax.Array],
) -> jax.Array:
    """For each new configuration in turn the best of `CANDIDATES` table entries, `(K, joints, lanes)`.

    A candidate is judged by the words that become known with it, earlier configurations and free poses given: squared
    distance of the origin and of the dot products to their intervals, `2 (1 - cos)` for a rotation vector. Candidates are the
    last axis here. Configurations `(joints, lanes)` in `fixed` are there already, for those after them to be judged by.
    """
    code, lanes = shared.code, pick.shape[1]
    size = tables.configurations.shape[-1]
    nothing = Pose(jnp.zeros((layout.tools, 3, 3, lanes)), jnp.zeros((layout.tools, 3, lanes)))
    atoms = all_atoms(given, nothing, free)
    all_rotation, all_position = jnp.asarray(tables.rotation), jnp.asarray(tables.position)
    stages = jnp.asarray(code.stage)
    if fixed:
        known = jnp.stack([fixed.get(k, jnp.zeros((layout.joints, lanes))) for k in range(layout.configurations)])
        own, _ = tools_at(layout, shared.chains, known)
        is_own = jnp.asarray([k in fixed for k in range(layout.configurations)])

    def stage(k: jax.Array, state: tuple[Pose, jax.Array]) -> tuple[Pose, jax.Array]:
        atoms, chosen = state
        start = (pick[k] * size).astype(jnp.int32)
        first = layout.first_tool + k * layout.chains
        tools = []
        for j in range(layout.chains):
            e = k * layout.chains + j
            flat = _fetch(jnp.concatenate([all_rotation[e].reshape(9, size), all_position[e]]), start)
            tools.append(Pose(flat[:9].reshape(3, 3, lanes, CANDIDATES), flat[9:]))

        def judge(word: jax.Array, score: jax.Array) -> jax.Array:
            before, after, which, flips = _around(code.words, word, first, layout.chains, atoms)
            before, after = (jax.tree.map(lambda a: a[..., None], pose) for pose in (before, after))
            tool = tools[0]
            for j in range(1, layout.chains):
                tool = jax.tree.map(lambda a, b, j=j: jnp.where(which == j, b, a), tool, tools[j])
            turn = jnp.where(flips, transpose(tool.rotation), tool.rotation)
            move = jnp.where(flips, -matvec(turn, tool.position), tool.position)
            turned = matmul(before.rotation, turn)
            position = before.position + matvec(before.rotation, move) + matvec(turned, after.position)
            rotation = matmul(turned, after.rotation)
            rows = jax.tree.map(lambda a: jnp.asarray(a)[..., word], shared.rows)

            def gap(value: jax.Array, row: int) -> jax.Array:
                return jnp.square(value - jnp.clip(value, rows.low[row], rows.high[row]))

            here = sum(gap(position[i], i) for i in range(3))
            chord = 3.0 - jnp.sum(rotation * rows.wanted[:, :, None, None], axis=(0, 1))
            dots = 0.0
            for i in range(3):
                held = sum(rotation[:, j] * rows.inner_axes[i, j] for j in range(3))
                dots = dots + gap(jnp.sum(held * rows.outer_axes[i][:, None, None], axis=0), 3 + i)
            return score + here + jnp.where(rows.as_vector > 0.5, chord, dots)

        def judge_if_due(word: jax.Array, score: jax.Array) -> jax.Array:
            return lax.cond(stages[word] == k + 1, lambda s: judge(word, s), lambda s: s, score)

        score = lax.fori_loop(0, layout.words, judge_if_due, jnp.zeros((lanes, CANDIDATES)))
        entry = (start + jnp.argmin(score, axis=1).astype(jnp.int32)) % size
        rotation, position = atoms
        for j in range(layout.chains):
            e = k * layout.chains + j
            turn, move = jnp.take(all_rotation[e], entry, axis=-1), jnp.take(all_position[e], entry, axis=-1)
            if fixed:
                turn, move = jnp.where(is_own[k], own.rotation[e], turn), jnp.where(is_own[k], own.position[e], move)
            rotation = lax.dynamic_update_index_in_dim(rotation, turn, first + j, 0)
            position = lax.dynamic_update_index_in_dim(position, move, first + j, 0)
        return Pose(rotation, position), chosen.at[k].set(entry)

    start = (atoms, jnp.zeros((layout.configurations, lanes), jnp.int32))
    chosen = lax.fori_loop(0, layout.configurations, stage, start)[1]
    q = jnp.asarray(tables.configurations)
    return jnp.stack([jnp.take(q[k], chosen[k], axis=1) for k in range(layout.configurations)])
