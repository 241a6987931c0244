"""Seed tables: random configurations with their tool poses, from which the device picks where a projection starts (`seeds`).

A `Pool` holds many random configurations of one robot. Its plain table is the first of them that collide with nothing that is
always there. An operator gets a table of its own, *aimed* at what its rows ask: most entries are the pool's nearest to targets
of the kind that the operator will see, since a projection that starts near its target arrives more often, in fewer steps, and
is less likely to collide there. All of this is host work in numpy, once per operator; the tables are kept in the cache on disk.
"""

from __future__ import annotations

import contextlib
import pickle
import threading
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from cgs_jax import cache
from cgs_jax.constraints import RowData, Term
from cgs_jax.kinematics import Chain, tool_poses_on_host
from cgs_jax.plans import Plan
from cgs_jax.poses import Array, Pose
from cgs_jax.seeds import PoseSeed

TABLE_SIZE = 4096
"""Entries of a seed table."""

POOL_SIZE = 2**18
"""Random configurations to choose from. The more, the nearer to a target are as many entries as the table has room for: with
fewer entries, taken several times, projections would succeed as often but reach less of what is feasible."""

NEAREST = 3 * TABLE_SIZE // 4
"""Entries of an aimed table that are near targets; the others are as in the plain table."""

TARGETS = 16
"""Targets that are drawn where what is given or free makes them differ from task to task."""

POOL_PER_TARGET = 2**16
"""Part of the pool that is looked at where there are several targets: the work is the product."""

PARENTS = 1536
"""Nearest free configurations of the pool."""

CHILDREN = 12
"""Further configurations around each of these: there are never enough near ones, and most of what is drawn at random is far."""

SPREAD = 0.07
"""Half width, relative to the joint's range, of the uniform offset of such a configuration."""

MOST_CHECKED = 20 * TABLE_SIZE
"""Configurations of which free ones are sought for a plain table."""

CHUNK = 4096
"""Configurations handled at once, so that they stay in the cache."""


Tools = dict[str, tuple[np.ndarray, np.ndarray]]
"""Poses of tools `(N, 3, 3)`, `(N, 3)` by chain, in its root frame."""


class SeedTable(NamedTuple):
    """Random configurations and the poses of their tools."""

    configurations: Array  # (dof, T)
    tools: dict[str, Pose]  # chain name -> (3, 3, T), (3, T) in the chain's root frame


class Pool:
    """Random configurations of one robot within its limits `(dof,)`, made when they are first asked for.

    is_free tells whether a configuration `(dof,)` collides with nothing that is always there. key: what that depends on; pools
    with the same limits, chains and key share tables in the cache on disk.
    """

    def __init__(
        self,
        low: np.ndarray,
        high: np.ndarray,
        chains: Mapping[str, Chain],
        is_free: Callable[[np.ndarray], bool],
        key: bytes,
    ) -> None:
        self._low, self._high, self._chains, self._is_free = low, high, dict(chains), is_free
        self._key = pickle.dumps((low, high, self._chains, key))
        self._free: dict[int, bool] = {}
        self._lock = threading.RLock()  # batches of several threads ask
        self._aimed: dict[bytes, SeedTable] = {}

    @cached_property
    def _configurations(self) -> np.ndarray:
        return np.random.default_rng(0).uniform(self._low, self._high, (POOL_SIZE, len(self._low)))

    @cached_property
    def _tools(self) -> Tools:
        return self._tools_at(self._configurations)

    def _tools_at(self, q: np.ndarray) -> Tools:
        return {name: _in_chunks(chain, q) for name, chain in self._chains.items()}

    def _first_free(self, numbers: Sequence[int] | np.ndarray, count: int) -> np.ndarray:
        """The first `count` of these entries that are free `(<= count, dof)`."""
        kept: list[int] = []
        for number in map(int, numbers):
            if len(kept) == count:
                break
            if number not in self._free:
                self._free[number] = self._is_free(self._configurations[number])
            if self._free[number]:
                kept.append(number)
        return self._configurations[kept]

    @cached_property
    def _plain(self) -> np.ndarray:
        kept = self._first_free(range(MOST_CHECKED), TABLE_SIZE)
        # Where nearly everything collides, colliding entries are better than none.
        return np.concatenate([kept, self._configurations[: TABLE_SIZE - len(kept)]])

    def _table(self, q: np.ndarray) -> SeedTable:
        tools = {
            name: Pose(np.moveaxis(rotation, 0, 2), np.ascontiguousarray(position.T))
            for name, (rotation, position) in self._tools_at(q).items()
        }
        return SeedTable(q.T.astype(np.float32), tools)

    @cached_property
    def plain(self) -> SeedTable:
        """Entries from the whole space."""
        return self._kept((), lambda: self._plain)

    def aimed(self, words: Sequence[Word]) -> SeedTable:
        """Most entries are near one of the targets of `words` or another; words have one target each or equally many."""
        key = pickle.dumps(list(words))
        with self._lock:
            if key not in self._aimed:
                self._aimed[key] = self._kept(words, lambda: self._near(words))
            return self._aimed[key]

    def _kept(self, words: Sequence[Word], make: Callable[[], np.ndarray]) -> SeedTable:
        """The table from the cache, or made and left there."""
        entry = cache.entry(".table", cache.DEVICE_SOURCES, np.__version__, self._key, pickle.dumps(list(words)))
        if entry is not None:
            # Whatever is wrong with an entry, it can be made again.
            with contextlib.suppress(Exception):
                return SeedTable(*pickle.loads(cache.read(entry)))
        with self._lock:
            table = self._table(make())
        if entry is not None:
            cache.store(entry, pickle.dumps(tuple(table)))
        return table

    def _near(self, words: Sequence[Word]) -> np.ndarray:
        rng = np.random.default_rng(0)
        one_target = all(word.samples == 1 for word in words)
        size = POOL_SIZE if one_target else POOL_PER_TARGET
        scores = _smallest_misses(words, {name: (turn[:size], move[:size]) for name, (turn, move) in self._tools.items()})
        # About half of what is near collides; in tight places more does.
        nearest = np.argpartition(scores, 4 * PARENTS)[: 4 * PARENTS]
        parents = self._first_free(nearest[np.argsort(scores[nearest])], PARENTS)
        if not len(parents):
            return self._plain
        offsets = SPREAD * (self._high - self._low) * rng.uniform(-1.0, 1.0, (CHILDREN, *parents.shape))
        near = np.concatenate([parents[None], np.clip(parents + offsets, self._low, self._high)]).reshape(-1, parents.shape[1])
        near = near[np.argsort(_smallest_misses(words, self._tools_at(near)))]
        # Beside what is free most is free. Where all tasks have the same target the rest is worth a look at each.
        near = np.array([q for q in near[: 3 * NEAREST] if self._is_free(q)] if one_target else near)[:NEAREST]
        near = np.resize(near, (NEAREST, near.shape[1]))
        return rng.permutation(np.concatenate([near, self._plain[: TABLE_SIZE - NEAREST]]))


def _smallest_misses(words: Sequence[Word], tools: Tools) -> np.ndarray:
    """Of each entry `(N,)` how far it is from the target that it is nearest to."""
    size = len(next(iter(tools.values()))[1])
    scores = np.empty(size, np.float32)
    for start in range(0, size, CHUNK):
        part = slice(start, start + CHUNK)
        misses = sum(_misses(word, *(a[part] for a in tools[word.chain])) for word in words)
        scores[part] = np.min(misses, axis=1)
    return scores


def _in_chunks(chain: Chain, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tools `(N, 3, 3)`, `(N, 3)` in single precision, the configurations last in memory."""
    chain = Chain(*(np.asarray(part, np.float32) for part in chain))
    rotation, position = np.empty((3, 3, len(q)), np.float32), np.empty((3, len(q)), np.float32)
    for start in range(0, len(q), CHUNK):
        part = slice(start, start + CHUNK)
        turned, moved = tool_poses_on_host(chain, q[part].astype(np.float32))
        rotation[..., part], position[:, part] = np.moveaxis(turned, 0, 2), moved.T
    return np.moveaxis(rotation, 2, 0), position.T


class Word(NamedTuple):
    """A product `before * tool * after`, or with the tool inverted, of which rows are read; S samples of what varies."""

    chain: str
    inverted: bool
    before: tuple[np.ndarray, np.ndarray]  # (S, 3, 3), (S, 3)
    after: tuple[np.ndarray, np.ndarray]  # (S, 3, 3), (S, 3)
    rows: RowData

    @property
    def samples(self) -> int:
        """S; what does not vary may be there once."""
        return max(len(self.before[1]), len(self.after[1]))


def _misses(word: Word, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """How far tools `(N, 3, 3)`, `(N, 3)` are from satisfying a word: `(N, S)`, in the measure of `seeds._choose`.

    Every number that rows are read from is linear in the tool's rotation and position.
    """
    if word.inverted:
        rotation = np.swapaxes(rotation, 1, 2)
        position = -np.einsum("nij,nj->ni", rotation, position)
    (turn, move), (after_turn, after_move) = word.before, word.after
    samples, rows = word.samples, word.rows
    # Coefficients of the rotation (S, R, 9) and of the position (S, R, 3), and constants (S, R).
    by_rotation = np.zeros((samples, 7, 3, 3))
    by_position = np.zeros((samples, 7, 3))
    constant = np.zeros((samples, 7))
    by_rotation[:, :3] = turn[:, :, :, None] * after_move[:, None, None, :]
    by_position[:, :3] = turn
    constant[:, :3] = move
    low, high = np.full(7, -np.inf), np.full(7, np.inf)
    low[:3], high[:3] = rows.low[:3], rows.high[:3]
    if rows.as_vector > 0.5:
        by_rotation[:, 6] = np.swapaxes(turn, 1, 2) @ rows.wanted @ np.swapaxes(after_turn, 1, 2)
    else:
        outer = np.einsum("ri,sij->srj", rows.outer_axes, turn)
        inner = np.einsum("sij,rj->sri", after_turn, rows.inner_axes)
        by_rotation[:, 3:6] = outer[..., None] * inner[..., None, :]
        low[3:6], high[3:6] = rows.low[3:], rows.high[3:]
    features = np.concatenate([rotation.reshape(-1, 9), position], axis=1).astype(np.float32)
    coefficients = np.concatenate([by_rotation.reshape(samples, 7, 9), by_position], axis=2).astype(np.float32)
    total = np.zeros((len(features), samples), np.float32)
    for row in range(7):
        if not (np.isfinite(low[row]) or np.isfinite(high[row])) and not (row == 6 and rows.as_vector > 0.5):
            continue
        value = features @ coefficients[:, row].T + constant[:, row].astype(np.float32)
        if row == 6:
            total += 3.0 - value
        else:
            total += np.square(value - np.clip(value, low[row], high[row]))
    return total


class Sources(NamedTuple):
    """Where samples of a plan's atoms come from."""

    constants: Mapping[str, np.ndarray]  # (7,) by name
    rows: Mapping[str, RowData]  # by constraint
    seeds: Mapping[str, PoseSeed]  # by constraint on one pose alone
    sites: Mapping[str, np.ndarray]  # by constraint of touch: (sites, 7)
    seed_of: Mapping[str, str]  # pose variable to such a constraint
    pools: Mapping[str, Pool]  # by configuration variable


def aimed_tables(plan: Plan, sources: Sources) -> list[SeedTable | None]:
    """A table for each new configuration of a plan; None where the plan asks nothing of it or what it asks is not known."""
    samples = _Samples(plan, sources)
    tables: list[SeedTable | None] = []
    for k, name in enumerate(plan.configurations):
        words = [word for word in (samples.word(at, k) for at in range(len(plan.rows))) if word is not None]
        tables.append(sources.pools[name].aimed(words) if words else None)
    return tables


class _Samples:
    """Poses of the atoms of a plan: what they are, or draws of the kind that tasks will bring."""

    def __init__(self, plan: Plan, sources: Sources) -> None:
        self._plan, self._sources = plan, sources
        self._atoms: dict[int, tuple[np.ndarray, np.ndarray] | None] = {0: (np.eye(3)[None], np.zeros((1, 3)))}

    def word(self, at: int, k: int) -> Word | None:
        """The plan's word `at` as asked of new configuration `k`; None if it is known before, later or not at all."""
        plan = self._plan
        layout, words = plan.layout, plan.code.words
        if not plan.rows[at] or plan.code.stage[at] != k + 1:
            return None
        first = layout.first_tool + k * layout.chains
        before = after = self._atoms[0]
        chain, flipped = "", False
        for atom, inverts in zip(words.atom[at], words.inverted[at], strict=True):
            if first <= atom < first + layout.chains and not chain:
                chain, flipped = plan.tools[k][int(atom) - first], bool(inverts)
                continue
            pose = self._atom(int(atom))
            if pose is None:
                return None  # another tool, say, which may be anywhere
            pose = _inverse(pose) if inverts else pose
            before, after = (before, _compose(after, pose)) if chain else (_compose(before, pose), after)
        if not chain:
            return None
        return Word(chain, flipped, before, after, self._sources.rows[plan.rows[at]])

    def _atom(self, atom: int) -> tuple[np.ndarray, np.ndarray] | None:
        if atom not in self._atoms:
            self._atoms[atom] = self._draw(atom)
        return self._atoms[atom]

    def _draw(self, atom: int) -> tuple[np.ndarray, np.ndarray] | None:
        layout, plan = self._plan.layout, self._plan
        if atom >= layout.first_free:
            return self._pose(plan.free[atom - layout.first_free][1])
        if atom >= layout.first_tool:
            return None
        if atom >= layout.first_site:
            return self._site(plan.sites[atom - layout.first_site])
        term: Term = plan.given[atom - 1]
        if term.kind == "constant":
            return _pose_of(np.asarray(self._sources.constants[term.name], float)[None])
        return self._pose(self._sources.seed_of.get(term.name)) if term.kind == "pose" else None

    def _site(self, constraint: str) -> tuple[np.ndarray, np.ndarray]:
        offered = np.asarray(self._sources.sites[constraint], float)
        return _pose_of(offered[_generator(constraint).integers(len(offered), size=TARGETS)])

    def _pose(self, constraint: str | None) -> tuple[np.ndarray, np.ndarray] | None:
        """Draws as `seeds.draw_pose` makes them; None where nothing bounds them."""
        if constraint is None:
            return None
        seed, rng = self._sources.seeds[constraint], _generator(constraint)
        low, high = np.asarray(seed.low, float), np.asarray(seed.high, float)
        if not np.isfinite([low, high]).all():
            return None
        position = rng.uniform(low, high, (TARGETS, 3))
        spin = Rotation.from_rotvec(np.asarray(seed.axis, float) * (2 * np.pi * rng.random((TARGETS, 1)) * float(seed.spins)))
        flip = Rotation.from_rotvec(np.asarray(seed.flip, float) * (np.pi * rng.integers(2, size=(TARGETS, 1))))
        rotation = np.asarray(seed.before, float) @ (flip * spin).as_matrix()
        if seed.anywhere > 0.5:
            rotation = Rotation.random(TARGETS, rng=rng).as_matrix()
        pose = (rotation, position)
        if constraint in self._sources.sites:
            pose = _compose(self._site(constraint), pose)
        return _inverse(pose) if seed.inverts > 0.5 else pose


def _generator(name: str) -> np.random.Generator:
    """The same draws for the same name, so that operators with the same targets share a table."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def _pose_of(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses `(S, 7)` as rotations and positions."""
    return Rotation.from_quat(vectors[:, 3:], scalar_first=True).as_matrix(), vectors[:, :3]


def _compose(
    a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    return a[0] @ b[0], a[1] + (a[0] @ b[1][..., None])[..., 0]


def _inverse(a: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    back = np.swapaxes(a[0], 1, 2)
    return back, -(back @ a[1][..., None])[..., 0]
