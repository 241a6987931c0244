"""Problems: a scene's task as a constraint graph with numbers.

`load_problem` reads the mode switches of a task and builds the paper's graph (Figure 2): a Kin factor where a hold begins or
ends, a Grasp on each hold's relative transform, a Position on each placement, a Collision on each configuration and on each
pair of configurations that meet at a switch. Everything that differs between instances (poses, sizes, bounds) is in `params`,
a pytree of arrays; the rest is structure, shared by all instances.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np

from cgs_jax.collisions import Body, Clearance, ClearanceData, Geom, pair_lists, read_shapes
from cgs_jax.constraints import (
    Declaration,
    Form,
    OwnSampler,
    PoseRows,
    Product,
    RowData,
    Term,
    count_rows,
    inverted,
    row_data,
    variables_of,
)
from cgs_jax.errors import InputError
from cgs_jax.graph import Constraint, ConstraintGraph, Variable
from cgs_jax.kinematics import Chain, ChainReader
from cgs_jax.poses import Array
from cgs_jax.scene import Hold, Robot, Scene, TouchGrasp, TwoFingerGrasp, load_scene, object_pose_sources
from cgs_jax.seeds import PoseSeed, pose_seed
from cgs_jax.tables import Pool, SeedTable
from cgs_jax.transitions import Transitions

Collisions = Literal["after", "inside"]
"""Where clearances are seen to: after the solver, where they reject, or inside it, as a row for the nearest pair of each."""


class Params(NamedTuple):
    """All numbers of an instance (float32 arrays); other numbers of the same shapes need no new trace."""

    constants: dict[str, Array]  # name -> (7,)
    chains: dict[str, Chain]  # "robot/frame"
    limits: dict[str, tuple[Array, Array]]  # configuration or vector variable -> (dof,), (dof,)
    rows: dict[str, RowData]  # by constraint
    seeds: dict[str, PoseSeed]  # by constraint on one pose alone
    sites: dict[str, Array]  # by constraint of touch: (sites, 7) T_object_site
    clearances: dict[str, ClearanceData]  # by constraint
    tables: dict[str, SeedTable]  # "robot" or "robot, hanging"; by name for a vector variable, whose entries are not used


class Exact(NamedTuple):
    """Constants and chains in double precision, for the keyframes."""

    constants: dict[str, np.ndarray]  # name -> (7,)
    chains: dict[str, Chain]


class Source(NamedTuple):
    """Path of a task file, instance, and how many problems this process had loaded before: the file may change meanwhile."""

    scene: str
    instance: int
    number: int


_loaded = itertools.count()


@dataclass(frozen=True, eq=False)
class Problem:
    """A constraint graph over a scene, and what its constraints compute."""

    scene: Scene
    graph: ConstraintGraph
    declarations: Mapping[str, Declaration]
    """What each constraint's rows are; constraints without rows of their own (Collision) are absent."""
    clearances: Mapping[str, Clearance]
    """Bodies whose live pairs a constraint answers for; absent where there are none."""
    table_of: Mapping[str, str]
    """Configuration or vector variable to the name of its seed table."""
    object_poses: Mapping[tuple[str, str], Product]
    """(object, switch) to its pose as a product."""
    base_poses: Mapping[tuple[str, str], Product]
    """(floating robot, switch) to the pose of its base as a product."""
    params: Params
    exact: Exact
    pools: Mapping[str, Pool]
    """By seed table of a robot: the configurations that tables are made of."""
    collisions: Collisions = "after"
    """Whether clearances are checked after the solver, or kept inside it."""
    source: Source | None = None
    """Where it was loaded from, if `load_problem` makes the same problem of that."""
    samplers: tuple[OwnSampler, ...] = ()
    """A user's direct samplers (`cgs_jax.with_sampler`)."""
    operators: dict = field(default_factory=dict, repr=False)
    """Operators by conditional problem, made on demand (`cgs_jax.operators.operator_of`)."""
    aimed: dict = field(default_factory=dict, repr=False)
    """Seed tables by operator's identity, made on demand (`cgs_jax.operators.aimed_at`) and kept from run to run."""

    @functools.cached_property
    def transitions(self) -> Transitions:
        """The pruned transitions of the graph."""
        return Transitions(self.graph)

    @functools.cached_property
    def dofs(self) -> dict[str, int | None]:
        """Numbers of each configuration or vector variable; None for a pose."""
        return {v.name: None if v.kind == "pose" else v.dof for v in self.graph.variables}

    @functools.cached_property
    def vectors(self) -> tuple[str, ...]:
        """A user's own variables (`cgs_jax.with_variable`)."""
        return tuple(v.name for v in self.graph.variables if v.kind == "vector")

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.scene.task.name


def load_problem(name_or_path: str | Path, instance: int = 0) -> Problem:
    """The problem of one instance of a scene, by name or by the path of a task file.

    Raises InputError (one line) for anything wrong with the scene; see `cgs_jax.scene.load_scene`.
    """
    scene = load_scene(name_or_path, instance)
    return dataclasses.replace(build_problem(scene), source=Source(str(scene.task.path), instance, next(_loaded)))


def build_problem(scene: Scene) -> Problem:
    """The problem of a loaded scene."""
    return _Builder(scene).build()


def with_collisions(problem: Problem, collisions: Collisions) -> Problem:
    """The same problem with its clearances checked after the solver, or kept inside it. Raises InputError for neither."""
    if collisions not in ("after", "inside"):
        raise InputError(f"collisions are seen to '{collisions}', expected one of: after, inside")
    if collisions == problem.collisions:
        return problem
    return dataclasses.replace(problem, collisions=collisions, operators={}, aimed={})


class _Builder:
    """Gathers the graph, the declarations and the numbers of one scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.task, self.model = scene, scene.task, scene.model
        self.sources = object_pose_sources(self.task)
        self.readers = {
            robot.name: ChainReader(self.model, robot.joints, scene.home_qpos, robot.base, robot.name)
            for robot in self.task.robots
        }
        self.constants: dict[str, np.ndarray] = {}
        self.chains: dict[str, Chain] = {}
        self.rows: dict[str, RowData] = {}
        self.seeds: dict[str, PoseSeed] = {}
        self.sites: dict[str, np.ndarray] = {}
        self.constraints: list[Constraint] = []
        self.declarations: dict[str, Declaration] = {}
        self.home = mujoco.MjData(self.model)
        self.home.qpos[:] = scene.home_qpos
        mujoco.mj_kinematics(self.model, self.home)

    # -------------------------------------------------------------- products

    def constant(self, name: str, pose: np.ndarray) -> Term:
        self.constants[name] = pose
        return Term("constant", name)

    def chain(self, robot: str, frame: str, variable: str) -> Term:
        name = f"{robot}/{frame}"
        chain = self.readers[robot].chain(frame)
        if not chain.hinge.size:
            # A site on the base does not move with the joints.
            return self.constant(name, pose_vector(chain.tool_rotation, chain.tool_offset))
        self.chains[name] = chain
        return Term("chain", name, variable)

    def hanging(self, robot: Robot, switch: str) -> Hold | None:
        """The hold that a floating robot hangs on at a switch, if it has lifted off before it."""
        at = self.task.switch_index(switch)
        for hold in self.task.holds:
            start, end = self.task.span(hold)
            if hold.supports and hold.robot == robot.name and start < at <= end:
                return hold
        return None

    def base_pose(self, robot: Robot, switch: str) -> Product:
        """T_world_base of a floating robot."""
        assert robot.base is not None
        hold = self.hanging(robot, switch)
        if hold is None:
            return (self.constant(f"base of {robot.name}", self.scene.object_pose(robot.base)),)
        variable = self.variable_at(robot.name, switch)
        if variable is None:
            raise InputError(
                f"{self.task.path.name}: floating robot '{robot.name}' hangs at switch '{switch}'; "
                "expected a configuration of it there"
            )
        to_frame = self.chain(robot.name, hold.frame, variable)
        return (*self.object_pose(hold.object, switch), Term("pose", hold.variable, inverted=True), to_frame.inverse)

    def variable_at(self, robot: str, switch: str) -> str | None:
        return self.task.switches[self.task.switch_index(switch)].configurations.get(robot)

    def frame_pose(self, robot_name: str, frame: str, switch: str) -> Product:
        """T_world_frame of a robot's site at a switch."""
        robot = self.task.robot(robot_name)
        variable = self.variable_at(robot_name, switch)
        if variable is None:
            return (self.constant(f"{frame} at home", self.scene.site_pose(frame)),)
        own = (self.chain(robot_name, frame, variable),)
        return own if robot.base is None else (*self.base_pose(robot, switch), *own)

    def object_pose(self, name: str, switch: str) -> Product:
        """T_world_object at a switch."""
        source = self.sources[name, switch]
        if source[0] == "start":
            return (self.constant(f"start of {name}", self.scene.object_pose(name)),)
        if source[0] == "goal":
            return (self.constant(f"goal of {name}", self.scene.site_pose(source[1])),)
        if source[0] == "variable":
            return (Term("pose", source[1]),)
        hold = self.task.hold(source[1])
        return (*self.frame_pose(hold.robot, hold.frame, switch), Term("pose", hold.variable))

    # -------------------------------------------------------------- factors

    def add(self, factor: str, scope: tuple[str, ...], rows: tuple[int, int], declaration: Declaration | None) -> str:
        ordered = tuple(name for name in self.names if name in scope)
        name = f"{factor}({','.join(ordered)})"
        if any(constraint.name == name for constraint in self.constraints):
            name += f"#{sum(c.name.startswith(name) for c in self.constraints) + 1}"
        self.constraints.append(Constraint(name, factor, ordered, *rows))
        if declaration is not None:
            self.declarations[name] = declaration
        return name

    def add_rows(self, factor: str, product: Product, form: Form, **numbers) -> str:
        data = row_data(form, **numbers)
        name = self.add(factor, variables_of(product), count_rows(data), PoseRows(product, form))
        self.rows[name] = data
        if form != "closed" and len(variables_of(product)) == 1:
            self.seeds[name] = pose_seed(form, **numbers)
        return name

    def add_grasp(self, hold: Hold) -> None:
        held = Term("pose", hold.variable)
        if isinstance(hold.grasp, TwoFingerGrasp):
            low, high = hold.grasp.low, hold.grasp.high
            self.add_rows("Grasp", (held.inverse,), "two_finger", low=low, high=high, axes=list(hold.grasp.rows))
            return
        assert isinstance(hold.grasp, TouchGrasp)
        body = self.scene.object_pose(hold.object)
        name = f"Grasp({hold.variable})"
        # T_site_gripper; the seed chooses the site.
        self.add_rows("Grasp", (Term("site", name).inverse, held.inverse), "touch")
        self.sites[name] = np.array([_relative_pose(body, self.scene.site_pose(site)) for site in hold.grasp.sites])

    def build(self) -> Problem:
        task = self.task
        self.names = task.variables
        configurations = {v: robot for s in task.switches for robot, v in s.configurations.items()}
        variables = []
        for name in self.names:
            if name in configurations:
                variables.append(Variable(name, len(task.robot(configurations[name]).joints), "configuration"))
            else:
                variables.append(Variable(name, 6, "pose"))
        for hold in task.holds:
            self.add_grasp(hold)
        for placement in task.placements:
            form: Form = "oriented" if placement.quat is not None else "upright" if placement.upright else "located"
            wanted = None if placement.quat is None else _matrix(np.array([0, 0, 0, *placement.quat]))[0]
            product = (Term("pose", placement.variable),)
            self.add_rows("Position", product, form, low=placement.low, high=placement.high, wanted=wanted)
        for hold in task.holds:
            ends = [hold.start] if hold.supports else [hold.start, hold.end]
            for end in ends:
                if self.sources[hold.object, end] == ("held", hold.variable):
                    continue
                left = (*self.frame_pose(hold.robot, hold.frame, end), Term("pose", hold.variable))
                self.add_rows("Kin", (*left, *inverted(self.object_pose(hold.object, end))), "closed")
        for goal in task.goals:
            if goal.full:
                continue
            rotation, position = _matrix(self.scene.site_pose(goal.site))
            low, high = (position, position) if goal.position else (np.full(3, -np.inf), np.full(3, np.inf))
            product = self.object_pose(goal.object, goal.at)
            self.add_rows("Goal", product, "oriented" if goal.rotation else "located", low=low, high=high, wanted=rotation)
        for switch in task.switches:
            moving = list(switch.configurations.values())
            for name in moving:
                self.add("Collision", (name,), (0, 1), None)
            for i, first in enumerate(moving):
                for second in moving[i + 1 :]:
                    self.add("Collision", (first, second), (0, 1), None)
        object_poses = {(o.name, s.name): self.object_pose(o.name, s.name) for o in task.objects for s in task.switches}
        base_poses = {
            (r.name, s.name): self.base_pose(r, s.name) for r in task.robots if r.base for s in task.switches
        }
        clearances, clearance_data = self.find_clearances(object_poses, base_poses)
        table_of = {
            name: robot if self.hanging(task.robot(robot), switch.name) is None else f"{robot}, hanging"
            for switch in task.switches
            for robot, name in switch.configurations.items()
        }
        pools = {name: self.pool(name) for name in sorted(set(table_of.values()))}
        params = Params(
            constants=self.constants,
            chains=self.chains,
            limits={name: self.limits(task.robot(robot)) for name, robot in configurations.items()},
            rows=self.rows,
            seeds=self.seeds,
            sites=self.sites,
            clearances=clearance_data,
            tables={name: pool.plain for name, pool in pools.items()},
        )
        return Problem(
            scene=self.scene,
            graph=ConstraintGraph(task.name, tuple(variables), tuple(self.constraints)),
            declarations=self.declarations,
            clearances=clearances,
            table_of=table_of,
            object_poses=object_poses,
            base_poses=base_poses,
            params=_single_precision(params),
            exact=Exact(self.constants, self.chains),
            pools=pools,
        )

    def limits(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        ranges = np.array([self.model.joint(joint).range for joint in robot.joints])
        return ranges[:, 0], ranges[:, 1]

    # -------------------------------------------------------------- collisions

    def find_clearances(
        self, object_poses: Mapping[tuple[str, str], Product], base_poses: Mapping[tuple[str, str], Product]
    ) -> tuple[dict[str, Clearance], dict[str, ClearanceData]]:
        """Assigns every live geom pair of every switch to the smallest constraint that covers its variables."""
        still_geoms: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]] = {}
        pairs: dict[tuple[str, ...], set] = {}
        live = self.scene.collision_pairs()
        for switch in self.task.switches:
            owner = [self._owner(geom, switch.name, object_poses, base_poses, still_geoms) for geom in range(self.model.ngeom)]
            for a, b in live:
                (body_a, key_a), (body_b, key_b) = owner[a], owner[b]
                if body_a.kind == body_b.kind == "still" or body_a == body_b and body_a.kind == "object":
                    continue
                variables = _body_variables(body_a) | _body_variables(body_b)
                entry = ((body_a, key_a, a), (body_b, key_b, b))
                pairs.setdefault(tuple(n for n in self.names if n in variables), set()).add(entry)
        grouped: dict[str, set] = {}
        for variables, entries in pairs.items():
            covering = [c for c in self.constraints if set(variables) <= set(c.scope)]
            covering.sort(key=lambda c: (len(c.scope), c.factor != "Collision"))
            name = covering[0].name if covering else self.add("Collision", variables, (0, 1), None)
            grouped.setdefault(name, set()).update(entries)
        clearances, data = {}, {}
        for name, entries in grouped.items():
            clearances[name], data[name] = self._clearance(entries, still_geoms)
        return clearances, data

    def _owner(
        self,
        geom: int,
        switch: str,
        object_poses: Mapping[tuple[str, str], Product],
        base_poses: Mapping[tuple[str, str], Product],
        still_geoms: dict,
    ) -> tuple[Body, str]:
        """The body that a geom belongs to at a switch, and where a still one stands."""
        body = int(self.model.geom_bodyid[geom])
        pose = (self.home.geom_xmat[geom].reshape(3, 3).copy(), self.home.geom_xpos[geom].copy())
        for robot in self.task.robots:
            reader = self.readers[robot.name]
            if reader.link_of_body(body) is None:
                continue
            variable = self.variable_at(robot.name, switch)
            if variable is not None:
                base = base_poses[robot.name, switch] if robot.base else ()
                return Body("robot", robot.name, variable, base), ""
        root = self.model.body_rootid[body]
        for spec in self.task.objects:
            if self.model.body(spec.body).id != root:
                continue
            product = object_poses[spec.name, switch]
            if variables_of(product):
                return Body("object", spec.name, None, product), ""
            wanted = self.constants[product[0].name]
            if len(product) == 1:
                rotation, position = _matrix(wanted)
                held = _matrix(self.scene.object_pose(spec.name))
                local = held[0].T @ pose[0], held[0].T @ (pose[1] - held[1])
                pose = rotation @ local[0], position + rotation @ local[1]
            still_geoms[product[0].name, geom] = pose
            return Body("still", "", None, ()), product[0].name
        still_geoms["home", geom] = pose
        return Body("still", "", None, ()), "home"

    def _clearance(self, entries: set, still_geoms: dict) -> tuple[Clearance, ClearanceData]:
        order = {"robot": 0, "object": 1, "still": 2}
        bodies = sorted({side[0] for entry in entries for side in entry}, key=lambda b: (order[b.kind], b.name, str(b)))
        shapes, places, chains = [], [], []
        for body in bodies:
            mine = sorted({(key, geom) for entry in entries for b, key, geom in entry if b == body})
            geoms = [self._geom(body, key, geom, still_geoms) for key, geom in mine]
            read, place = read_shapes(self.model, geoms)
            shapes.append(read)
            places.append(dict(zip(mine, place, strict=True)))
            if body.kind == "robot":
                chains.append(self.readers[body.name].links)
        live = [
            tuple((bodies.index(b), *places[bodies.index(b)][key, geom]) for b, key, geom in entry)
            for entry in sorted(entries, key=lambda e: [(s[0].kind, s[0].name, s[1], s[2]) for s in e])
        ]
        return Clearance(tuple(bodies)), ClearanceData(tuple(shapes), tuple(chains), pair_lists(live, shapes))

    def _geom(self, body: Body, key: str, geom: int, still_geoms: dict) -> Geom:
        if body.kind == "still":
            return Geom(geom, 0, *still_geoms[key, geom])
        if body.kind == "object":
            held = _matrix(self.scene.object_pose(body.name))
            rotation, position = self.home.geom_xmat[geom].reshape(3, 3), self.home.geom_xpos[geom]
            return Geom(geom, 0, held[0].T @ rotation, held[0].T @ (position - held[1]))
        reader = self.readers[body.name]
        link = reader.link_of_body(int(self.model.geom_bodyid[geom])) or 0
        data = reader.data
        return Geom(geom, link, *reader.in_link(link, data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]))

    # -------------------------------------------------------------- seed tables

    def pool(self, name: str) -> Pool:
        """Random configurations that collide with nothing that is always there: the robot itself and, standing, the world."""
        robot = self.task.robot(name.split(",")[0])
        hangs = name != robot.name
        reader = self.readers[robot.name]
        mine = np.array([reader.link_of_body(int(b)) is not None for b in self.model.geom_bodyid])
        fixed = (self.model.body_weldid[self.model.geom_bodyid] == 0) & (not hangs)
        counted = mine | fixed
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.scene.home_qpos

        def is_free(q: np.ndarray) -> bool:
            data.qpos[reader.qpos_addresses] = q
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_collision(self.model, data)
            if not data.ncon:
                return True
            contact = data.contact
            return not np.any(counted[contact.geom].all(axis=1) & (contact.dist < 0))

        chains = {key: chain for key, chain in self.chains.items() if key.split("/")[0] == robot.name}
        key = pickle.dumps((self._model_digest, reader.qpos_addresses, counted, self.scene.home_qpos))
        return Pool(*self.limits(robot), chains, is_free, key)

    @functools.cached_property
    def _model_digest(self) -> str:
        """Of all numbers of the model, and of the MuJoCo that reads them."""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return hashlib.sha256(mujoco.__version__.encode() + buffer.tobytes()).hexdigest()


def _body_variables(body: Body) -> set[str]:
    return set(variables_of(body.pose)) | ({body.variable} if body.variable else set())


def _matrix(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(pose[3:], dtype=float))
    return rotation.reshape(3, 3), np.asarray(pose[:3], dtype=float)


def _relative_pose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """T_a_b (7,) from two world poses."""
    rotation_a, position_a = _matrix(a)
    rotation_b, position_b = _matrix(b)
    return pose_vector(rotation_a.T @ rotation_b, rotation_a.T @ (position_b - position_a))


def pose_vector(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """`[x y z qw qx qy qz]` of a rotation matrix and a position."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return np.concatenate([position, quat])


def _single_precision(params: Params) -> Params:
    def convert(value):
        if isinstance(value, np.ndarray):
            return value if value.dtype == np.int32 else np.asarray(value, dtype=np.float32)
        if isinstance(value, dict):
            return {name: convert(entry) for name, entry in value.items()}
        parts = [convert(entry) for entry in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)

    return convert(params)

