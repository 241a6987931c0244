"""Constraints on products of poses, and a user's functions and samplers.

Kin, Grasp and Position are one thing: a product of poses (constants, pose variables, tools of chains at configurations) and
six rows on its value, `low <= row <= high` each. The first three rows are its origin. The last three are its rotation, read
in one of two ways: as the rotation vector from a wanted rotation, or as dot products of pairs of axes.

    Kin           the product around the loop is the identity: origin and rotation vector are zero (6 rows)
    two fingers   T_object_gripper: origin within bounds of the object, axes of gripper and object perpendicular (4 rows
                  and bounds in the scenes)
    touch         T_site_gripper: origin zero, z axes opposed (5 rows and the sign of the third dot product)
    oriented      T_world_object: origin within bounds, rotation as wanted (3 rows and bounds)
    upright       T_world_object: origin within bounds, z axis up (2 rows, 1 more where z is pinned, a sign and bounds)
    located       T_world_object: origin within bounds

Declarations name variables and are hashable; the numbers are traced. Rows that say nothing are open (`-inf`, `inf`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from cgs_jax.poses import Array, Pose, cross, matmul, matvec, retract, rotation_log, to_vector, transpose

Form = Literal["closed", "two_finger", "touch", "oriented", "upright", "located"]


@dataclass(frozen=True)
class Term:
    """One factor of a product of poses.

    kind "pose": the pose variable `name`; "constant": the constant pose `name`; "chain": the tool of chain `name`
    ("robot/frame") at the configuration variable `variable`; "site": the touch site that a seed chose for constraint `name`.
    """

    kind: Literal["pose", "constant", "chain", "site"]
    name: str
    variable: str | None = None
    inverted: bool = False

    @property
    def inverse(self) -> Term:
        """The same factor inverted."""
        return Term(self.kind, self.name, self.variable, not self.inverted)

    @property
    def depends_on(self) -> tuple[str, ...]:
        """The variables it mentions (one or none)."""
        if self.kind == "pose":
            return (self.name,)
        return () if self.variable is None else (self.variable,)


Product = tuple[Term, ...]


def inverted(product: Product) -> Product:
    """The inverse of a product of poses."""
    return tuple(term.inverse for term in reversed(product))


def variables_of(product: Product) -> tuple[str, ...]:
    """Variables that a product mentions, each once, in order."""
    return tuple(dict.fromkeys(name for term in product for name in term.depends_on))


@dataclass(frozen=True)
class PoseRows:
    """Six rows on a product of poses; the numbers are `RowData` under the constraint's name."""

    product: Product
    form: Form

    @property
    def scope(self) -> tuple[str, ...]:
        """Variables it mentions."""
        return variables_of(self.product)

    def solved_for(self, pose: str) -> Product | None:
        """The product that a pose variable of a closed loop equals; None for other forms or where it appears not once."""
        places = [i for i, term in enumerate(self.product) if term.kind == "pose" and term.name == pose]
        if self.form != "closed" or len(places) != 1:
            return None
        at = places[0]
        value = inverted(self.product[:at]) + inverted(self.product[at + 1 :])
        return inverted(value) if self.product[at].inverted else value


@dataclass(frozen=True)
class Function:
    """A user's constraint: a JAX function of its variables' values, one lane at a time, to `rows` numbers.

    Configurations and vectors arrive as `(dof,)`, poses as `(7,)` `[x y z qw qx qy qz]`, each under the variable's name.
    `kind` says whether the rows must be zero or at most zero.
    """

    function: Callable[..., jax.Array]
    scope: tuple[str, ...]
    kind: Literal["equality", "inequality"]
    rows: int


Declaration = PoseRows | Function


@dataclass(frozen=True)
class OwnSampler:
    """A user's direct sampler: a JAX function of a key and the values of `given`, one lane at a time, to `variables`.

    Values arrive and leave as in `Function`. It returns one array if `single`, else one per variable in their order.
    """

    function: Callable[..., jax.Array | tuple[jax.Array, ...]]
    variables: tuple[str, ...]
    given: tuple[str, ...]
    single: bool

    @property
    def link(self) -> str:
        """Name of the constraint without rows that ties what is given to what is drawn, where no other does."""
        given = f"|{','.join(self.given)}" if self.given else ""
        return f"Sampler({','.join(self.variables)}{given})"

    def draw(self, key: jax.Array, given: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
        """Values by variable, for one lane."""
        result = self.function(key, **given)
        parts = (result,) if self.single else result
        return {name: jnp.asarray(part, jnp.float32) for name, part in zip(self.variables, parts, strict=True)}


class RowData(NamedTuple):
    """The numbers of one `PoseRows`."""

    low: Array  # (6,) m for the first three rows, rad or 1 for the others
    high: Array  # (6,)
    as_vector: Array  # () 1: the rotation rows are the rotation vector from `wanted`; 0: dot products
    wanted: Array  # (3, 3)
    outer_axes: Array  # (3, 3) row i: axis in the frame that the product is expressed in (object, site, world)
    inner_axes: Array  # (3, 3) row i: axis of the frame that the product maps from (gripper, object)


def row_data(
    form: Form,
    low: Array = (0.0, 0.0, 0.0),
    high: Array = (0.0, 0.0, 0.0),
    wanted: Array | None = None,
    axes: list[tuple[Array, Array, float]] | None = None,
) -> RowData:
    """Numbers of a form; `low`, `high` bound the origin (m), `axes` are (gripper axis, object axis, dot product) triples."""
    eye, infinite = np.eye(3), np.full(3, np.inf)
    rows_low, rows_high = -infinite, infinite.copy()
    outer, inner = eye.copy(), eye.copy()
    if form in ("closed", "oriented"):
        rows_low, rows_high = np.zeros(3), np.zeros(3)
    elif form in ("touch", "upright"):
        # x and y components of the inner z axis vanish; its z component is negative (opposed) or positive (up).
        inner = np.tile(eye[2], (3, 1))
        rows_low, rows_high = np.array([0.0, 0.0, -np.inf]), np.array([0.0, 0.0, 0.0])
        if form == "upright":
            rows_low, rows_high = np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, np.inf])
    elif form == "two_finger":
        for i, (gripper, held, dot) in enumerate(axes or []):
            inner[i], outer[i] = gripper, held
            rows_low[i] = rows_high[i] = dot
    return RowData(
        low=np.concatenate([np.asarray(low, dtype=float), rows_low]),
        high=np.concatenate([np.asarray(high, dtype=float), rows_high]),
        as_vector=np.asarray(float(form in ("closed", "oriented"))),
        wanted=eye if wanted is None else np.asarray(wanted, dtype=float),
        outer_axes=outer,
        inner_axes=inner,
    )


def count_rows(data: RowData) -> tuple[int, int]:
    """Equality rows (all of them independent) and inequality rows of these numbers."""
    low, high = np.asarray(data.low), np.asarray(data.high)
    equal = low == high
    return int(equal.sum()), int((np.isfinite(low) & ~equal).sum() + (np.isfinite(high) & ~equal).sum())


class PoseRowValues(NamedTuple):
    """Rows of a product's value, lanes last."""

    value: jax.Array  # (6, lanes)
    turn: jax.Array  # (3, 3, lanes) derivative of the rotation rows by the product's angular velocity


def pose_rows(pose: Pose, data: RowData) -> PoseRowValues:
    """Evaluates the six rows; any lane axes, the numbers of `data` have as many axes of length one or the lanes' own.

    The derivative of the rotation vector is taken at zero error, where it is the identity. A dot product changes as
    `d(u . R v) = w . (R v x u)`.
    """
    vector = rotation_log(matmul(pose.rotation, transpose(data.wanted)))
    turned = jnp.stack([matvec(pose.rotation, data.inner_axes[i]) for i in range(3)])  # (row, 3, lanes)
    dots = jnp.stack([jnp.sum(turned[i] * data.outer_axes[i], axis=0) for i in range(3)])
    turns = jnp.stack([cross(turned[i], jnp.broadcast_to(data.outer_axes[i], turned[i].shape)) for i in range(3)])
    as_vector = data.as_vector > 0.5
    identity = jnp.eye(3, dtype=turns.dtype).reshape((3, 3) + (1,) * (turns.ndim - 2))
    rotation = jnp.where(as_vector, vector, dots)
    value = jnp.concatenate([jnp.broadcast_to(pose.position, rotation.shape), rotation])
    return PoseRowValues(value, jnp.where(as_vector, identity, turns))


class FunctionArgument(NamedTuple):
    """A variable as a user's function meets it: its value per lane, and its derivative by the unknowns."""

    value: jax.Array | Pose  # configuration (dof, lanes) or pose
    tangent: jax.Array | None  # (dof or 6, n, lanes); None: it does not move


def function_rows(
    function: Function, arguments: Mapping[str, FunctionArgument], unknowns: int
) -> tuple[jax.Array, jax.Array]:
    """Rows `(rows, lanes)` of a user's function and their Jacobian `(rows, n, lanes)` by forward differentiation."""
    values = {name: arguments[name].value for name in function.scope}
    lanes = max(leaf.shape[-1] for leaf in jax.tree.leaves(values))
    values = jax.tree.map(lambda a: jnp.broadcast_to(a, a.shape[:-1] + (lanes,)), values)

    def moved(value: jax.Array | Pose, step: jax.Array) -> jax.Array:
        if not isinstance(value, Pose):
            return value + step
        lane = jax.tree.map(lambda a: a[..., None], value)
        return to_vector(retract(lane, step[:, None]))[:, 0]

    def rows(steps: dict[str, jax.Array], point: dict[str, jax.Array | Pose]) -> jax.Array:
        result = function.function(**{name: moved(point[name], steps[name]) for name in function.scope})
        chex.assert_shape(result, (function.rows,))
        return result

    zero = {name: jnp.zeros(6 if isinstance(v, Pose) else v.shape[0]) for name, v in values.items()}

    def one_lane(point: dict[str, jax.Array | Pose]) -> tuple[jax.Array, dict[str, jax.Array]]:
        return rows(zero, point), jax.jacfwd(rows)(zero, point)

    value, local = jax.vmap(one_lane, in_axes=-1, out_axes=-1)(values)
    jacobian = jnp.zeros((function.rows, unknowns, lanes), value.dtype)
    for name in function.scope:
        tangent = arguments[name].tangent
        if tangent is not None:
            jacobian = jacobian + jnp.sum(local[name][:, :, None] * tangent[None], axis=1)
    return value, jacobian
