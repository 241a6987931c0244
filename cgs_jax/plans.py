"""How a conditional problem is evaluated: words of poses.

A new pose that occurs in one closed loop whose other factors are known need not be an unknown: the loop *defines* it, exactly
and at every iterate (t = T_world_gripper(q)^-1 T_world_object, say). Substituting the definitions leaves fewer unknowns and
rows, and seeds of configurations only.

What remains is one *word* per product that rows are read from: a sequence of atoms (given poses, touch sites, tools of new
configurations, free poses) or their inverses. Words are data. A device program depends only on a `Layout`, the numbers of new
configurations, free poses and rows, so that the dozens of conditional problems of a task share a handful of compiled programs,
and another robot, switch or constant is another argument.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cgs_jax.augmented_lagrangian import Rows
from cgs_jax.collisions import Body, ClearanceData, PlacedShapes, link_frames, nearest_contact, place_links, place_object
from cgs_jax.constraints import (
    Declaration,
    Function,
    FunctionArgument,
    OwnSampler,
    PoseRows,
    Product,
    RowData,
    Term,
    function_rows,
    inverted,
    pose_rows,
)
from cgs_jax.distance import materialise
from cgs_jax.kinematics import Chain, joint_frames, tool_jacobian, tool_pose
from cgs_jax.poses import Array, Pose, cross, matmul, matvec, retract, transpose

# ------------------------------------------------------------------ structure


class FunctionSlot(NamedTuple):
    """A user's function and where its arguments are: ("configuration", position, joints) or ("word", position, 7)."""

    function: Function
    arguments: tuple[tuple[str, int, int], ...]
    constraint: int


class SamplerSlot(NamedTuple):
    """A user's sampler by position.

    Arguments, in the order of its given variables: ("pose", given atom - 1, 7), ("configuration", position among those that
    functions read, dof), or ("drawn", 0, 0) for what a sampler before it drew. Results, in the order of its variables:
    ("free", free pose, 7) or ("configuration", new configuration, dof).
    """

    sampler: OwnSampler
    arguments: tuple[tuple[str, int, int], ...]
    results: tuple[tuple[str, int, int], ...]
class BodySlot(NamedTuple):
    """A body of a clearance and where it is: position of its configuration (-1: none) and of its pose's word (-1: none)."""

    kind: str  # "robot", "object", "still"
    configuration: int
    word: int


class ClearanceSlot(NamedTuple):
    """A clearance that is kept by a row: its smallest signed distance must not be negative."""

    bodies: tuple[BodySlot, ...]
    constraint: int


AIM = 2e-3
"""Largest clearance (m) that a penetrating pair is moved to; each lane has its own."""


@dataclass(frozen=True)
class Layout:
    """What a device program is compiled for. Atoms: identity, given poses, touch sites, tools, free poses."""

    joints: int
    """Joints of the longest chain; shorter ones are padded with joints that do not move."""
    configurations: int
    """New configurations K, each a block of `joints` unknowns; a user's vector is one without tools."""
    chains: int
    """Tools per configuration."""
    free: int
    """Free poses F, each a block of six unknowns."""
    words: int
    """Words that rows are read from, six rows each."""
    given: int
    """Room for given poses."""
    sites: int
    """Room for touch sites."""
    length: int
    """Room for atoms in a word."""
    tool_places: int
    """Room for occurrences of tools in words."""
    free_places: int
    """Room for occurrences of free poses in words."""
    constraints: int
    """Room for constraints in the report of violations."""
    functions: tuple[FunctionSlot, ...] = ()
    """A user's functions; a program that has any serves one problem only."""
    samplers: tuple[SamplerSlot, ...] = ()
    """A user's samplers, in the order in which they draw; a program that has any serves one problem only."""
    vectors: tuple[int, ...] = ()
    """Which of the new configurations are a user's vectors."""
    units: tuple[float, ...] = ()
    """Change of each number per unit of its unknown (n,); empty where all are one."""
    clearances: tuple[ClearanceSlot, ...] = ()
    """Clearances that have a row."""
    bare: int = 0
    """Words at the end that only clearances read; they have no rows."""

    @property
    def unknowns(self) -> int:
        """Number n of unknowns."""
        return self.joints * self.configurations + 6 * self.free

    @property
    def tools(self) -> int:
        """Number of tools."""
        return self.configurations * self.chains

    @property
    def first_site(self) -> int:
        """Atom of the first site."""
        return 1 + self.given

    @property
    def first_tool(self) -> int:
        """Atom of the first tool."""
        return self.first_site + self.sites

    @property
    def first_free(self) -> int:
        """Atom of the first free pose."""
        return self.first_tool + self.tools

    @property
    def solves(self) -> bool:
        """Whether there is anything to solve: without, drawing the free poses is all (and judging what is defined)."""
        closed_form = not (self.configurations or self.functions or self.samplers or self.clearances)
        closed_form &= self.words - self.bare <= self.free
        return bool(self.unknowns) and not closed_form


class Words(NamedTuple):
    """Products as atoms, traced; padded with the identity."""

    atom: Array  # (words, length) int32
    inverted: Array  # (words, length) bool
    length: Array  # () int32 of the longest


class Places(NamedTuple):
    """Where moving atoms of one kind occur in the words, traced; one entry per occurrence."""

    word: Array  # (places,) int32
    position: Array  # (places,) int32
    source: Array  # (places,) int32 tool or free pose
    block: Array  # (places,) int32 configuration or free pose
    inverted: Array  # (places,) bool
    count: Array  # () int32 entries in use


class Code(NamedTuple):
    """All words of a plan."""

    words: Words
    tools: Places
    free: Places
    outputs: Words  # words of the new poses
    stage: Array  # (words,) int32 number of configurations that a word needs
    constraint: Array  # (words,) int32 position of its constraint; `constraints` where it has none


SAMPLED_UNIT = 0.05
"""Unit of the unknowns that a user's sampler drew: a least-norm step moves them by this squared of what it moves others that
could do as well, so that they stay near what was drawn wherever the others can solve the rest."""

OUTPUTS = 4
"""Room for new poses in the output of a program; problems with fewer share it."""


@dataclass(frozen=True)
class Plan:
    """A conditional problem as words: structure, data, and the names behind the positions."""

    layout: Layout
    code: Code
    configurations: tuple[str, ...]
    """New configurations, in order."""
    given: tuple[Term, ...]
    """What the given atoms are, from atom 1 on: pose variables, constants, tools of given configurations."""
    sites: tuple[str, ...]
    """Constraint whose touch site each site atom is."""
    tools: tuple[tuple[str, ...], ...]
    """Chains of each new configuration."""
    free: tuple[tuple[str, str | None], ...]
    """Free poses, each with the constraint that its seed is drawn from."""
    rows: tuple[str, ...]
    """Constraint of each word; "" for a word that only a user's function reads."""
    poses: tuple[str, ...]
    """New pose variables in the order of the output words."""
    given_configurations: tuple[str, ...]
    """Given configurations and vectors that a user's function or sampler, or a clearance's row reads."""


def make_plan(
    new: Sequence[str],
    declarations: Mapping[str, Declaration],
    dofs: Mapping[str, int | None],
    lengths: Mapping[str, int],
    joints: int,
    sites: int,
    ranges: Mapping[str, tuple[float, ...]] | None = None,
    samplers: Sequence[OwnSampler] = (),
    clearances: Mapping[str, Sequence[Body]] | None = None,
) -> Plan:
    """Plans the conditional problem of `new` variables under active constraints.

    `dofs` has each configuration variable's number of joints, None for a pose; `lengths` the joints of each chain; `joints`
    and `sites` the most that any robot and any conditional problem of the task has (so that layouts are shared). `clearances`
    has the bodies of those that are to be kept by a row, by constraint. Poses are
    defined greedily: configurations are taken one by one, always the one that completes most products; where every loop left
    has two or more unknown poses, one of them becomes free. `ranges` has the widths of a user's vectors, which are planned as
    configurations without tools; `samplers` those that draw here, in order: a pose that one draws is free from the start.
    """
    new_poses = [name for name in new if dofs[name] is None]
    new_configurations = [name for name in new if dofs[name] is not None]
    drawn = {name for sampler in samplers for name in sampler.variables}
    free: list[str] = [name for name in new_poses if name in drawn]
    while True:
        order, defined, read, undetermined = _eliminate(new_configurations, new_poses, free, drawn, declarations)
        if not undetermined:
            break
        loops = [d for n, d in declarations.items() if isinstance(d, PoseRows) and d.form == "closed" and n not in read]
        stuck = [p for d in loops for p in d.scope if p in undetermined]
        free.append((stuck or undetermined)[0])
    known = ranges or {}, samplers, clearances or {}
    return _Assembler(order, new_poses, free, defined, read, declarations, dofs, lengths, joints, sites, *known).plan()


class _Definition(NamedTuple):
    constraint: str
    pose: str
    value: Product
    stage: int


def _eliminate(
    configurations: list[str],
    poses: list[str],
    free: list[str],
    drawn: set[str],
    declarations: Mapping[str, Declaration],
) -> tuple[list[str], list[_Definition], dict[str, int], list[str]]:
    """Order of configurations; definitions in order; constraints read as rows with their stage; poses left undetermined."""
    new = {*configurations, *poses}

    def propagate(known: set[str], used: set[str], stage: int) -> tuple[list[_Definition], dict[str, int]]:
        found: list[_Definition] = []
        rows: dict[str, int] = {}
        progress = True
        while progress:
            progress = False
            for name, declaration in declarations.items():
                if name in used:
                    continue
                missing = [v for v in declaration.scope if v in new and v not in known]
                if not missing:
                    used.add(name)
                    rows[name] = stage
                elif len(missing) == 1 and missing[0] in poses and isinstance(declaration, PoseRows):
                    value = declaration.solved_for(missing[0])
                    if value is not None:
                        used.add(name)
                        known.add(missing[0])
                        found.append(_Definition(name, missing[0], value, stage))
                        progress = True
        return found, rows

    known, used = set(free), set[str]()
    defined, read = propagate(known, used, 0)
    order: list[str] = []
    while len(order) < len(configurations):

        def completes(candidate: str) -> tuple[bool, int]:
            # What a user's sampler draws is there for the others to be judged by.
            found, rows = propagate(known | {candidate}, set(used), 0)
            return candidate in drawn, len(found) + len(rows)

        best = max((c for c in configurations if c not in order), key=completes)
        order.append(best)
        known.add(best)
        found, rows = propagate(known, used, len(order))
        defined += found
        read |= rows
    return order, defined, read, [p for p in poses if p not in known]


def _rounded(count: int, step: int) -> int:
    return -(-count // step) * step


def _reduced(product: Product) -> Product:
    """Cancels factors that stand beside their own inverse."""
    kept: list[Term] = []
    for term in product:
        if kept and kept[-1] == term.inverse:
            kept.pop()
        else:
            kept.append(term)
    return tuple(kept)


class _Assembler:
    """Substitutes the definitions, numbers the atoms and writes the words."""

    def __init__(
        self,
        order: list[str],
        new_poses: list[str],
        free: list[str],
        defined: list[_Definition],
        read: dict[str, int],
        declarations: Mapping[str, Declaration],
        dofs: Mapping[str, int | None],
        lengths: Mapping[str, int],
        joints: int,
        sites: int,
        ranges: Mapping[str, tuple[float, ...]],
        samplers: Sequence[OwnSampler],
        clearances: Mapping[str, Sequence[Body]],
    ) -> None:
        self.clearances = clearances
        self.order, self.new_poses, self.free = order, new_poses, free
        self.declarations, self.dofs, self.lengths, self.joints, self.sites = declarations, dofs, lengths, joints, sites
        self.ranges, self.samplers = ranges, samplers
        self.values: dict[str, Product] = {}
        for definition in defined:
            self.values[definition.pose] = self._substituted(definition.value)
        self.words: list[tuple[str, Product, int]] = []
        self.functions: dict[str, Function] = {}
        for name, stage in read.items():
            declaration = declarations[name]
            if isinstance(declaration, PoseRows):
                self.words.append((name, self._substituted(declaration.product), stage))
            else:
                self.functions[name] = declaration
        # A function reads poses as words without rows.
        self.read_by_functions = dict.fromkeys(
            v for f in self.functions.values() for v in f.scope if dofs[v] is None
        )
        for name in self.read_by_functions:
            self.words.append(("", self._substituted((Term("pose", name),)), len(order)))

    def _substituted(self, product: Product) -> Product:
        result: list[Term] = []
        for term in product:
            if term.kind == "pose" and term.name in self.values:
                value = self.values[term.name]
                result += inverted(value) if term.inverted else value
            else:
                result.append(term)
        return _reduced(tuple(result))

    def plan(self) -> Plan:
        outputs = [self._substituted((Term("pose", name),)) for name in self.new_poses]
        products = [product for _, product, _ in self.words]
        reading = max(len(products), len(self.order) + len(self.free), 1)
        products += [()] * (reading - len(products) if self.clearances else 0)
        bodies = [body for of_clearance in self.clearances.values() for body in of_clearance]
        bare = list(dict.fromkeys(self._substituted(body.pose) for body in bodies if body.pose))
        products += bare
        given: dict[Term, None] = {}
        tools: dict[str, dict[str, None]] = {name: {} for name in self.order}
        sites: dict[str, None] = {}
        for term in (term for product in products + outputs for term in product):
            if term.kind == "site":
                sites[term.name] = None
            elif term.kind == "chain" and term.variable in tools and self.lengths[term.name]:
                tools[term.variable][term.name] = None
            elif term.kind != "pose" or term.name not in self.free:
                given[Term(term.kind, term.name, term.variable)] = None
        given |= dict.fromkeys(Term("pose", v) for v in self._read_by_samplers() if self.dofs[v] is None)
        chains = max([len(names) for names in tools.values()], default=1) or 1
        words = reading + len(bare)
        first_tool = 1 + _rounded(max(len(given), 1), 12) + self.sites
        atoms: dict[Term, int] = {term: 1 + i for i, term in enumerate(given)}
        atoms |= {Term("site", name): first_tool - self.sites + i for i, name in enumerate(sites)}
        for k, name in enumerate(self.order):
            for i, chain in enumerate(tools[name]):
                atoms[Term("chain", chain, name)] = first_tool + k * chains + i
        first_free = first_tool + len(self.order) * chains
        atoms |= {Term("pose", name): first_free + i for i, name in enumerate(self.free)}
        constraints = list(dict.fromkeys([*self.declarations, *self.clearances]))
        of_configurations = _places(products, lambda t: self.order.index(t.variable) if t.variable in self.order else -1)
        of_free = _places(products, lambda t: self.free.index(t.name) if t.kind == "pose" and t.name in self.free else -1)
        layout = Layout(
            joints=self.joints if self.order else 0,
            configurations=len(self.order),
            chains=chains,
            free=len(self.free),
            words=words,
            given=first_tool - self.sites - 1,
            sites=self.sites,
            # A word may go through the tools of all new configurations: many of them have long words somewhere. A program
            # that loops over few atoms takes as long with room for more, and one program less has to be compiled.
            length=_rounded(max([4 * len(self.order), *(len(product) for product in products + outputs)]), 12),
            tool_places=_rounded(max(len(of_configurations), 1), 4 * words) if self.order else 0,
            free_places=_rounded(max(len(of_free), 1), 4 * words) if self.free else 0,
            constraints=_rounded(len(constraints), 16),
            functions=tuple(
                FunctionSlot(f, tuple(self._argument(v) for v in f.scope), constraints.index(name))
                for name, f in self.functions.items()
            ),
            samplers=tuple(self._sampler_slot(sampler, list(given)) for sampler in self.samplers),
            vectors=tuple(k for k, name in enumerate(self.order) if name in self.ranges),
            units=self._units(),
            clearances=tuple(
                ClearanceSlot(tuple(self._body(body, bare, reading) for body in of_clearance), constraints.index(name))
                for name, of_clearance in self.clearances.items()
            ),
            bare=len(bare),
        )
        stage = np.full(words, len(self.order) + 1, np.int32)
        constraint = np.full(words, layout.constraints, np.int32)
        for i, (name, _, needed) in enumerate(self.words):
            if name:
                stage[i], constraint[i] = needed, constraints.index(name)
        code = Code(
            words=_words(products, atoms, words, layout.length),
            tools=_place_arrays(of_configurations, atoms, first_tool, layout.tool_places),
            free=_place_arrays(of_free, atoms, first_free, layout.free_places),
            outputs=_words(outputs, atoms, max(OUTPUTS, len(outputs)), layout.length),
            stage=stage,
            constraint=constraint,
        )
        return Plan(
            layout=layout,
            code=code,
            configurations=tuple(self.order),
            given=tuple(given),
            sites=tuple(sites),
            tools=tuple(tuple(tools[name]) for name in self.order),
            free=tuple((name, self._seed_of(name)) for name in self.free),
            rows=tuple(name for name, _, _ in self.words),
            poses=tuple(self.new_poses),
            given_configurations=tuple(self._read_configurations()),
        )

    def _read_configurations(self) -> list[str]:
        read = [v for f in self.functions.values() for v in f.scope] + self._read_by_samplers()
        read += [body.variable for bodies in self.clearances.values() for body in bodies if body.variable]
        return list(dict.fromkeys(v for v in read if self.dofs[v] is not None and v not in self.order))

    def _body(self, body: Body, bare: list[Product], first: int) -> BodySlot:
        at = [*self.order, *self._read_configurations()].index(body.variable) if body.variable else -1
        return BodySlot(body.kind, at, first + bare.index(self._substituted(body.pose)) if body.pose else -1)

    def _read_by_samplers(self) -> list[str]:
        """Given variables that samplers read."""
        new = {*self.order, *self.new_poses}
        return [name for sampler in self.samplers for name in sampler.given if name not in new]

    def _units(self) -> tuple[float, ...]:
        """A vector's unit is its range: steps of one size must suit joints and newtons alike. What a sampler drew is stiff."""
        drawn = {name for sampler in self.samplers for name in sampler.variables}
        if not drawn | (self.ranges.keys() & set(self.order)):
            return ()
        units: list[float] = []
        for name in (*self.order, *self.free):
            size = self.joints if name in self.order else 6
            own = self.ranges.get(name, ())
            widths = (*own, *(1.0,) * (size - len(own)))
            units += [SAMPLED_UNIT * width if name in drawn else width for width in widths]
        return tuple(units)

    def _sampler_slot(self, sampler: OwnSampler, given: list[Term]) -> SamplerSlot:
        def argument(variable: str) -> tuple[str, int, int]:
            dof = self.dofs[variable]
            if variable in self.order or variable in self.new_poses:
                return "drawn", 0, 0
            if dof is None:
                return "pose", given.index(Term("pose", variable)), 7
            return "configuration", self._read_configurations().index(variable), dof

        def result(variable: str) -> tuple[str, int, int]:
            dof = self.dofs[variable]
            return ("free", self.free.index(variable), 7) if dof is None else ("configuration", self.order.index(variable), dof)

        return SamplerSlot(sampler, tuple(map(argument, sampler.given)), tuple(map(result, sampler.variables)))

    def _argument(self, variable: str) -> tuple[str, int, int]:
        dof = self.dofs[variable]
        if dof is None:
            own = len(self.words) - len(self.read_by_functions)
            return "word", own + list(self.read_by_functions).index(variable), 7
        return "configuration", [*self.order, *self._read_configurations()].index(variable), dof

    def _seed_of(self, pose: str) -> str | None:
        """The constraint on a free pose alone that its seed is drawn from."""
        for name, declaration in self.declarations.items():
            if isinstance(declaration, PoseRows) and declaration.scope == (pose,):
                return name
        return None


class _Place(NamedTuple):
    word: int
    position: int
    term: Term
    block: int


def _places(products: list[Product], block_of: Callable[[Term], int]) -> list[_Place]:
    return [
        _Place(w, i, term, block_of(term))
        for w, product in enumerate(products)
        for i, term in enumerate(product)
        if block_of(term) >= 0
    ]


def _place_arrays(places: list[_Place], atoms: Mapping[Term, int], first: int, room: int) -> Places:
    rows = []
    for place in places:
        plain = Term(place.term.kind, place.term.name, place.term.variable)
        rows.append((place.word, place.position, atoms[plain] - first, place.block, place.term.inverted))
    rows += [(0, 0, 0, 0, False)] * (room - len(rows))
    columns = np.array(rows, np.int32).reshape(room, 5).T
    count = np.asarray(len(places), np.int32)
    return Places(columns[0], columns[1], columns[2], columns[3], columns[4].astype(bool), count)


def _words(products: list[Product], atoms: Mapping[Term, int], room: int, length: int) -> Words:
    atom, flips = np.zeros((room, length), np.int32), np.zeros((room, length), bool)
    for w, product in enumerate(products):
        for i, term in enumerate(product):
            atom[w, i] = atoms[Term(term.kind, term.name, term.variable)]
            flips[w, i] = term.inverted
    return Words(atom, flips, np.asarray(max([len(product) for product in products], default=0), np.int32))


# ------------------------------------------------------------------ evaluation


class Shared(NamedTuple):
    """What all tasks of a call have in common."""

    code: Code
    chains: Chain  # stacked on the last axis: tools of the new configurations in order, (..., tools)
    rows: RowData  # stacked on the last axis, (..., words that have rows)
    clearances: tuple[ClearanceData, ...] = ()  # of those that have a row


class Tasks(NamedTuple):
    """What differs from task to task; lanes last."""

    given: Pose  # (given + sites, 3, 3, lanes), (given + sites, 3, lanes)
    low: Array  # (configurations, joints, lanes) limits that the solver keeps to
    high: Array  # (configurations, joints, lanes)
    slack: Array  # (2, lanes) in [0, 1): how far inside an interval a violated row is pulled
    configurations: tuple[Array, ...]  # given ones that functions and clearances read, (dof, lanes)


class Point(NamedTuple):
    """Values of the unknowns; lanes last."""

    configurations: Array  # (configurations, joints, lanes)
    free: Pose  # (free, 3, 3, lanes), (free, 3, lanes)


class Prefixes(NamedTuple):
    """Products of the first l factors of each word, words beside lanes: entry l of `(length + 1, 3, 3, words, lanes)`."""

    rotation: jax.Array
    position: jax.Array  # (length + 1, 3, words, lanes)
    whole: Pose  # (3, 3, words, lanes), (3, words, lanes) the words themselves


def _pick(array: jax.Array, indices: jax.Array, axis: int) -> jax.Array:
    """Entries of the first axis, stacked on `axis`, by dynamic slices: XLA's CPU gather goes element by element."""
    parts = [lax.dynamic_index_in_dim(array, indices[i], 0, keepdims=False) for i in range(indices.shape[0])]
    return jnp.stack(parts, axis=axis)


def multiply_words(words: Words, atoms: Pose) -> Prefixes:
    """Prefix products of all words; `atoms` is `(atoms, 3, 3, lanes)`, `(atoms, 3, lanes)`.

    Entries beyond the longest word are undefined, those beyond a shorter word repeat its product.
    """
    count, length = words.atom.shape
    lanes = atoms.position.shape[-1]
    dtype = atoms.position.dtype
    rotation = jnp.broadcast_to(jnp.eye(3, dtype=dtype)[..., None, None], (3, 3, count, lanes))
    position = jnp.zeros((3, count, lanes), dtype)
    rotations = jnp.zeros((length + 1, *rotation.shape), dtype).at[0].set(rotation)
    positions = jnp.zeros((length + 1, *position.shape), dtype)

    def body(i: jax.Array, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        rotation, position, rotations, positions = state
        index, flips = words.atom[:, i], words.inverted[:, i][:, None]
        turn, move = _pick(atoms.rotation, index, 2), _pick(atoms.position, index, 1)
        turn = jnp.where(flips, transpose(turn), turn)
        move = jnp.where(flips, -matvec(turn, move), move)
        position = position + matvec(rotation, move)
        rotation = matmul(rotation, turn)
        return (
            rotation,
            position,
            lax.dynamic_update_index_in_dim(rotations, rotation, i + 1, 0),
            lax.dynamic_update_index_in_dim(positions, position, i + 1, 0),
        )

    state = lax.fori_loop(0, words.length, body, (rotation, position, rotations, positions))
    return Prefixes(state[2], state[3], Pose(state[0], state[1]))


def tools_at(layout: Layout, chains: Chain, configurations: Array) -> tuple[Pose, jax.Array]:
    """Tools `(tools, 3, 3, lanes)`, `(tools, 3, lanes)` and their Jacobians `(tools, 6, joints, lanes)`."""
    if not layout.configurations:
        lanes = configurations.shape[-1]
        none = Pose(jnp.zeros((0, 3, 3, lanes)), jnp.zeros((0, 3, lanes)))
        return none, jnp.zeros((0, 6, layout.joints, lanes))
    # Tools are evaluated beside each other: (joints, tools, lanes).
    q = jnp.swapaxes(jnp.repeat(configurations, layout.chains, axis=0), 0, 1)
    frames = joint_frames(chains, q)
    tool = tool_pose(chains, frames)
    jacobian = jnp.moveaxis(tool_jacobian(chains, frames, tool), 2, 0)
    return Pose(jnp.moveaxis(tool.rotation, 2, 0), jnp.moveaxis(tool.position, 1, 0)), jacobian


def all_atoms(given: Pose, tools: Pose, free: Pose) -> Pose:
    """Identity, given poses and sites, tools, free poses, in the order of their numbers."""
    lanes = given.position.shape[-1]
    dtype = given.position.dtype
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype)[None, ..., None], (1, 3, 3, lanes))
    return Pose(
        jnp.concatenate([eye, given.rotation, tools.rotation, free.rotation]),
        jnp.concatenate([jnp.zeros((1, 3, lanes), dtype), given.position, tools.position, free.position]),
    )


def _carried(places: Places, tangents: jax.Array, sources: Array, prefixes: Prefixes, blocks: int) -> jax.Array:
    """Derivatives of the words by one kind of atom: `(6, n, words * blocks, lanes)`, word by word.

    `tangents` `(sources, 6, n, lanes)` moves the atoms themselves, whose origins are `sources` `(sources, 3, lanes)`. With the
    product (R, p) before an atom (S, s; v, w), p' after it and the word's origin e, the atom moves the word by
    `R v + (R w) x (e - p')` and turns it by `R w`. An inverse moves by `S^T (w x s - v)` and turns by `-S^T w`; `R S^T` is the
    rotation after it.
    """
    words, lanes = prefixes.position.shape[2:]
    n = tangents.shape[2]

    def add(i: jax.Array, total: jax.Array) -> jax.Array:
        word, position, flips = places.word[i], places.position[i], places.inverted[i]

        def at(array: jax.Array, entry: jax.Array) -> jax.Array:
            row = lax.dynamic_index_in_dim(array, entry, 0, keepdims=False)
            return lax.dynamic_index_in_dim(row, word, row.ndim - 2, keepdims=False)

        carrier = jnp.where(flips, -at(prefixes.rotation, position + 1), at(prefixes.rotation, position))[:, :, None]
        end = lax.dynamic_index_in_dim(prefixes.whole.position, word, 1, keepdims=False)
        arm = (end - at(prefixes.position, position + 1))[:, None]
        tangent = lax.dynamic_index_in_dim(tangents, places.source[i], 0, keepdims=False)
        place = lax.dynamic_index_in_dim(sources, places.source[i], 0, keepdims=False)[:, None]
        turn = tangent[3:]
        move = tangent[:3] - jnp.where(flips, 1.0, 0.0) * cross(turn, place)
        turned = matvec(carrier, turn)
        part = jnp.concatenate([matvec(carrier, move) + cross(turned, arm), turned])[:, :, None]
        slot = word * blocks + places.block[i]
        return lax.dynamic_update_slice_in_dim(total, lax.dynamic_slice_in_dim(total, slot, 1, 2) + part, slot, 2)

    start = jnp.zeros((6, n, words * blocks, lanes), tangents.dtype)
    return lax.fori_loop(0, places.count, add, start)


class PlanSystem:
    """A layout as the solver's `System`."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout

    def _products(self, x: Point, tasks: Tasks, shared: Shared) -> tuple[Pose, Prefixes, jax.Array, Pose]:
        """Atoms, prefix products, tool Jacobians and tools."""
        tools, jacobians = tools_at(self.layout, shared.chains, x.configurations)
        atoms = all_atoms(tasks.given, tools, x.free)
        return atoms, multiply_words(shared.code.words, atoms), jacobians, tools

    def rows(self, x: Point, data: tuple[Tasks, Shared]) -> Rows:
        """All rows with their Jacobian; violated bounds are pulled inside by each lane's own slack."""
        tasks, shared = data
        layout, code = self.layout, shared.code
        lanes = tasks.slack.shape[-1]
        _, prefixes, jacobians, tools = self._products(x, tasks, shared)
        parts = []
        if layout.configurations:
            tangent = _carried(code.tools, jacobians, tools.position, prefixes, layout.configurations)
            parts.append(_by_word(tangent, layout.words, layout.configurations))
        if layout.free:
            identity = jnp.broadcast_to(jnp.eye(6)[None, ..., None], (layout.free, 6, 6, lanes))
            tangent = _carried(code.free, identity, x.free.position, prefixes, layout.free)
            parts.append(_by_word(tangent, layout.words, layout.free))
        tangents = jnp.concatenate(parts, axis=2) if len(parts) > 1 else parts[0]  # (words, 6, n, lanes)
        read = layout.words - layout.bare
        measured = pose_rows(self._with_rows(prefixes), _with_lane(shared.rows))
        value = jnp.moveaxis(measured.value, 1, 0).reshape(6 * read, lanes)
        jacobian = jnp.concatenate([tangents[:read, :3], _turn_rows(measured.turn, tangents[:read, 3:])], axis=1)
        jacobian = jacobian.reshape(6 * read, layout.unknowns, lanes)
        low, high = (jnp.asarray(bound).T.reshape(-1, 1) for bound in (shared.rows.low, shared.rows.high))
        for slot in layout.functions:
            arguments = self._arguments(slot, x, tasks, prefixes, tangents)
            more, slope = function_rows(slot.function, arguments, layout.unknowns)
            size = slot.function.rows
            value = jnp.concatenate([value, jnp.broadcast_to(more, (size, lanes))])
            jacobian = jnp.concatenate([jacobian, jnp.broadcast_to(slope, (size, layout.unknowns, lanes))])
            least = 0.0 if slot.function.kind == "equality" else -jnp.inf
            low = jnp.concatenate([low, jnp.full((size, 1), least)])
            high = jnp.concatenate([high, jnp.zeros((size, 1))])
        width = high - low
        inside = jnp.where(jnp.isfinite(width), 0.5 * width, 0.0)
        aim_low, aim_high = low + tasks.slack[0] * inside, high - tasks.slack[1] * inside
        for slot, clearance in zip(layout.clearances, shared.clearances, strict=True):
            distance, slope = self._clearance(slot, clearance, x, tasks, prefixes, tangents)
            value, jacobian = jnp.concatenate([value, distance[None]]), jnp.concatenate([jacobian, slope[None]])
            low, high = jnp.concatenate([low, jnp.zeros((1, 1))]), jnp.concatenate([high, jnp.full((1, 1), jnp.inf)])
            aim_low = jnp.concatenate([aim_low, AIM * tasks.slack[:1]])
            aim_high = jnp.concatenate([aim_high, jnp.full((1, lanes), jnp.inf)])
        return Rows(value, low, high, aim_low, aim_high, self._times_units(jacobian))

    def _with_rows(self, prefixes: Prefixes) -> Pose:
        read = self.layout.words - self.layout.bare
        return Pose(prefixes.whole.rotation[:, :, :read], prefixes.whole.position[:, :read])

    def _clearance(
        self,
        slot: ClearanceSlot,
        data: ClearanceData,
        x: Point,
        tasks: Tasks,
        prefixes: Prefixes,
        tangents: jax.Array | None,
    ) -> tuple[jax.Array, jax.Array]:
        """Smallest signed distance `(lanes,)` of a clearance, and its derivative `(n, lanes)` through the nearest pair.

        The nearest pair's distance changes by the normal's part in the relative velocity of its two points.
        """
        layout, lanes = self.layout, tasks.slack.shape[-1]
        placed: list[PlacedShapes] = []
        joints: list[tuple[jax.Array, jax.Array] | None] = []
        chains = iter(data.chains)
        of_robot: list[Chain | None] = []
        for body, shapes in zip(slot.bodies, data.shapes, strict=True):
            pose = None
            if body.word >= 0:
                pose = Pose(prefixes.whole.rotation[:, :, body.word], prefixes.whole.position[:, body.word])
            if body.kind != "robot":
                placed.append(place_object(shapes, pose))
                joints.append(None)
                of_robot.append(None)
                continue
            chain = next(chains)
            if body.configuration < layout.configurations:
                q = x.configurations[body.configuration, : chain.offset.shape[0]]
            else:
                q = tasks.configurations[body.configuration - layout.configurations]
            frames = link_frames(chain, q, pose)
            placed.append(place_links(shapes, *frames))
            joints.append(frames)
            of_robot.append(chain)
        contact = nearest_contact(placed, data.shapes, data.pairs)
        apart = contact.separation
        distance = jnp.broadcast_to(apart.distance, (lanes,))
        slope = jnp.zeros((layout.unknowns, lanes))
        if tangents is None:
            return distance, slope
        for k, (body, frames, chain) in enumerate(zip(slot.bodies, joints, of_robot, strict=True)):
            for side, (sign, point) in enumerate(((-1.0, apart.point_a), (1.0, apart.point_b))):
                push = jnp.where(contact.bodies[side] == k, sign, 0.0) * apart.normal  # (3, lanes)
                if body.word >= 0:
                    arm = point - prefixes.whole.position[:, body.word]
                    wrench = jnp.concatenate([push, cross(arm, push)])
                    slope = slope + jnp.sum(tangents[body.word] * wrench[:, None], axis=0)
                if frames is None or chain is None or body.configuration >= layout.configurations:
                    continue
                axis, origin = frames[0][1:, :, 2], frames[1][1:]  # (joints, 3, lanes)
                lever = jnp.moveaxis(point[None] - origin, 1, 0)
                axis = jnp.moveaxis(axis, 1, 0)  # (3, joints, lanes)
                hinge, slide = (jnp.asarray(a)[:, None] for a in (chain.hinge, chain.slide))
                velocity = cross(axis, lever) * hinge + axis * slide
                moves = contact.links[side][None] > jnp.arange(axis.shape[1])[:, None]
                part = jnp.where(moves, jnp.sum(velocity * push[:, None], axis=0), 0.0)
                first = body.configuration * layout.joints
                slope = slope.at[first : first + axis.shape[1]].add(part)
        return materialise((distance, slope))

    def values(self, x: Point, data: tuple[Tasks, Shared]) -> tuple[jax.Array, Pose]:
        """The rows' values `(m, lanes)` alone, and the new poses `(3, 3, outputs, lanes)`."""
        tasks, shared = data
        atoms, prefixes, _, _ = self._products(x, tasks, shared)
        lanes = tasks.slack.shape[-1]
        measured = pose_rows(self._with_rows(prefixes), _with_lane(shared.rows)).value
        parts = [jnp.moveaxis(measured, 1, 0).reshape(-1, lanes)]
        for slot in self.layout.functions:
            more, _ = function_rows(slot.function, self._arguments(slot, x, tasks, prefixes, None), self.layout.unknowns)
            parts.append(jnp.broadcast_to(more, (slot.function.rows, lanes)))
        for clear, clearance in zip(self.layout.clearances, shared.clearances, strict=True):
            parts.append(self._clearance(clear, clearance, x, tasks, prefixes, None)[0][None])
        return jnp.concatenate(parts), multiply_words(shared.code.outputs, atoms).whole

    def _arguments(
        self, slot: FunctionSlot, x: Point, tasks: Tasks, prefixes: Prefixes, tangents: jax.Array | None
    ) -> dict[str, FunctionArgument]:
        layout = self.layout
        arguments = {}
        for name, (kind, at, size) in zip(slot.function.scope, slot.arguments, strict=True):
            if kind == "word":
                pose = Pose(prefixes.whole.rotation[:, :, at], prefixes.whole.position[:, at])
                arguments[name] = FunctionArgument(pose, None if tangents is None else tangents[at])
            elif at >= layout.configurations:
                arguments[name] = FunctionArgument(tasks.configurations[at - layout.configurations], None)
            else:
                # Robots with fewer joints than the longest are padded.
                identity = jnp.eye(size, layout.unknowns, at * layout.joints)[..., None]
                arguments[name] = FunctionArgument(x.configurations[at, :size], identity)
        return arguments

    def _times_units(self, by_unknown: jax.Array) -> jax.Array:
        """`(..., n, lanes)` with each unknown times its unit."""
        return by_unknown * jnp.asarray(self.layout.units)[:, None] if self.layout.units else by_unknown

    def room(self, x: Point, data: tuple[Tasks, Shared]) -> tuple[jax.Array, jax.Array]:
        """Limits of joints and vectors; poses are unbounded."""
        tasks, _ = data
        lanes = tasks.slack.shape[-1]
        joints = self.layout.joints * self.layout.configurations
        unbounded = jnp.full((6 * self.layout.free, lanes), jnp.inf)
        least = (tasks.low - x.configurations).reshape(joints, lanes)
        most = (tasks.high - x.configurations).reshape(joints, lanes)
        room = jnp.concatenate([least, -unbounded]), jnp.concatenate([most, unbounded])
        if not self.layout.units:
            return room
        units = jnp.asarray(self.layout.units)[:, None]
        return room[0] / units, room[1] / units

    def retract(self, x: Point, step: jax.Array) -> Point:
        """Adds to the configurations, moves the free poses."""
        joints = self.layout.joints * self.layout.configurations
        step = self._times_units(step)
        q = x.configurations + step[:joints].reshape(x.configurations.shape)
        if not self.layout.free:
            return Point(q, x.free)
        poses = [
            retract(Pose(x.free.rotation[f], x.free.position[f]), step[joints + 6 * f : joints + 6 * f + 6])
            for f in range(self.layout.free)
        ]
        return Point(q, Pose(jnp.stack([p.rotation for p in poses]), jnp.stack([p.position for p in poses])))

    def violations(self, x: Point, data: tuple[Tasks, Shared]) -> tuple[jax.Array, Pose]:
        """Largest violation per constraint `(constraints, lanes)`, m or rad, and the new poses `(3, 3, outputs, lanes)`."""
        tasks, shared = data
        layout = self.layout
        lanes = tasks.slack.shape[-1]
        atoms, prefixes, _, _ = self._products(x, tasks, shared)
        value = pose_rows(self._with_rows(prefixes), _with_lane(shared.rows)).value
        low, high = (jnp.asarray(bound)[..., None] for bound in (shared.rows.low, shared.rows.high))
        worst = jnp.max(jnp.abs(value - jnp.clip(value, low, high)), axis=0)  # (words, lanes)
        worst = jnp.where(jnp.isfinite(worst), worst, jnp.inf)
        result = jnp.zeros((layout.constraints + 1, lanes), value.dtype).at[shared.code.constraint[: value.shape[1]]].max(worst)
        for slot in layout.functions:
            more, _ = function_rows(slot.function, self._arguments(slot, x, tasks, prefixes, None), layout.unknowns)
            gap = jnp.abs(more) if slot.function.kind == "equality" else jnp.maximum(more, 0.0)
            gap = jnp.where(jnp.isfinite(gap), gap, jnp.inf)
            result = result.at[slot.constraint].max(jnp.broadcast_to(jnp.max(gap, axis=0), (lanes,)))
        for clear, clearance in zip(layout.clearances, shared.clearances, strict=True):
            distance, _ = self._clearance(clear, clearance, x, tasks, prefixes, None)
            result = result.at[clear.constraint].max(jnp.where(jnp.isfinite(distance), jnp.maximum(-distance, 0.0), jnp.inf))
        return result[: layout.constraints], multiply_words(shared.code.outputs, atoms).whole


def _with_lane(rows: RowData) -> RowData:
    return jax.tree.map(lambda a: jnp.asarray(a)[..., None], rows)


def _by_word(tangent: jax.Array, words: int, blocks: int) -> jax.Array:
    """`(6, n, words * blocks, lanes)` -> `(words, 6, blocks * n, lanes)`."""
    parts = [[tangent[:, :, w * blocks + b] for b in range(blocks)] for w in range(words)]
    return jnp.stack([jnp.concatenate(row, axis=1) if blocks > 1 else row[0] for row in parts])


def _turn_rows(turn: jax.Array, angular: jax.Array) -> jax.Array:
    """`turn` (3, 3, words, lanes) times angular velocities (words, 3, n, lanes) -> (words, 3, n, lanes)."""
    rows = [
        turn[i, 0][:, None] * angular[:, 0] + turn[i, 1][:, None] * angular[:, 1] + turn[i, 2][:, None] * angular[:, 2]
        for i in range(3)
    ]
    return jnp.stack(rows, axis=1)
