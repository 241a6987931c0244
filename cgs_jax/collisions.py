"""Clearance: the smallest signed distance over the live geom pairs that a constraint answers for.

A clearance has bodies (links of a robot at a configuration, an object at a pose, what stands still) with capsules, spheres
and boxes, and lists of geom pairs. Bodies, shapes and pairs are traced, so that other obstacles, another arm or another
switch share one compiled program.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cgs_jax.constraints import Product
from cgs_jax.distance import (
    Separation,
    box_box,
    box_box_distance,
    capsule_box,
    capsule_box_distance,
    capsule_capsule,
    capsule_capsule_distance,
    materialise,
)
from cgs_jax.kinematics import Chain, joint_frames
from cgs_jax.poses import Array, Pose, matmul, matvec

FAR = 1e3
"""Distance in m that stands for no pair at all."""


class Shapes(NamedTuple):
    """Capsules (spheres have equal ends) and boxes of one body, in the frames of its links (m)."""

    starts: Array  # (3, C)
    ends: Array  # (3, C)
    radii: Array  # (C,)
    capsule_links: Array  # (C,) int32
    centres: Array  # (3, K)
    rotations: Array  # (3, 3, K)
    halves: Array  # (3, K)
    box_links: Array  # (K,) int32


class Pairs(NamedTuple):
    """Live pairs as positions among all capsules and all boxes of the bodies in order, int32."""

    capsule_capsule: Array  # (2, P)
    capsule_box: Array  # (2, P)
    box_box: Array  # (2, P)


class Body(NamedTuple):
    """What moves as one: hashable, names of variables.

    "robot": links at configuration `variable`, the base at `pose` (empty: fixed). "object": one link at `pose`. "still": the
    world's frame.
    """

    kind: Literal["robot", "object", "still"]
    name: str
    variable: str | None
    pose: Product


class Clearance(NamedTuple):
    """Names behind `ClearanceData`: the bodies whose pairs a constraint answers for."""

    bodies: tuple[Body, ...]


class ClearanceData(NamedTuple):
    """Numbers of a clearance."""

    shapes: tuple[Shapes, ...]  # per body
    chains: tuple[Chain, ...]  # per robot body: all its joints
    pairs: Pairs


class PlacedShapes(NamedTuple):
    """Shapes in the world frame, lanes last."""

    starts: jax.Array  # (3, C, lanes)
    ends: jax.Array  # (3, C, lanes)
    radii: jax.Array  # (C, 1)
    centres: jax.Array  # (3, K, lanes)
    rotations: jax.Array  # (3, 3, K, lanes)
    halves: jax.Array  # (3, K, 1)


def place_links(shapes: Shapes, rotations: jax.Array, positions: jax.Array) -> PlacedShapes:
    """Shapes with their links at `(links, 3, 3, lanes)`, `(links, 3, lanes)`."""

    def frames(links: Array) -> tuple[jax.Array, jax.Array]:
        at = jnp.asarray(links)
        return jnp.moveaxis(rotations[at], 0, 2), jnp.moveaxis(positions[at], 0, 1)

    turn, move = frames(shapes.capsule_links)
    starts = move + matvec(turn, jnp.asarray(shapes.starts)[..., None])
    ends = move + matvec(turn, jnp.asarray(shapes.ends)[..., None])
    turn, move = frames(shapes.box_links)
    centres = move + matvec(turn, jnp.asarray(shapes.centres)[..., None])
    turned = matmul(turn, jnp.asarray(shapes.rotations)[..., None])
    return PlacedShapes(
        starts, ends, jnp.asarray(shapes.radii)[:, None], centres, turned, jnp.asarray(shapes.halves)[..., None]
    )


def link_frames(chain: Chain, q: Array, base: Pose | None) -> tuple[jax.Array, jax.Array]:
    """Root and joint frames of a robot at `q` `(n, lanes)` in the world: `(n + 1, 3, 3, lanes)`, `(n + 1, 3, lanes)`.

    `base` is the root frame in the world, None for a fixed base.
    """
    frames = joint_frames(chain, q)
    lanes = q.shape[1]
    root = Pose(jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, lanes)), jnp.zeros((3, lanes)))
    rotations = jnp.concatenate([root.rotation[None], frames.rotation])
    positions = jnp.concatenate([root.position[None], frames.position])
    if base is not None:
        turn = base.rotation[:, :, None]
        moved = jnp.moveaxis(positions, 0, 1)
        positions = jnp.moveaxis(base.position[:, None] + matvec(turn, moved), 1, 0)
        rotations = jnp.moveaxis(matmul(turn[:, :, :, :], jnp.moveaxis(rotations, 0, 2)), 2, 0)
    return rotations, positions


def place_robot(shapes: Shapes, chain: Chain, q: Array, base: Pose | None) -> PlacedShapes:
    """Shapes of a robot at `q` `(n, lanes)`; `base` is its root frame in the world, None for a fixed base."""
    return place_links(shapes, *link_frames(chain, q, base))


def place_object(shapes: Shapes, pose: Pose | None) -> PlacedShapes:
    """Shapes of an object at a pose; None is the world frame."""
    if pose is None:
        pose = Pose(jnp.eye(3)[..., None], jnp.zeros((3, 1)))
    return place_links(shapes, pose.rotation[None], pose.position[None])


def _joined(bodies: list[PlacedShapes]) -> PlacedShapes:
    """The shapes of all bodies in order, all with their lanes."""
    lanes = max(max(body.starts.shape[-1], body.centres.shape[-1]) for body in bodies)

    def joined(field: str) -> jax.Array:
        parts = [getattr(body, field) for body in bodies]
        return jnp.concatenate([jnp.broadcast_to(part, part.shape[:-1] + (lanes,)) for part in parts], axis=-2)

    return PlacedShapes(*map(joined, PlacedShapes._fields))


def _capsules(shapes: PlacedShapes, index: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    starts, ends, radii = (jnp.take(a, jnp.asarray(index), axis=-2) for a in (shapes.starts, shapes.ends, shapes.radii))
    return starts, ends, radii


def _boxes(shapes: PlacedShapes, index: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    fields = (shapes.centres, shapes.rotations, shapes.halves)
    centres, rotations, halves = (jnp.take(a, jnp.asarray(index), axis=-2) for a in fields)
    return centres, rotations, halves


_KINDS = (
    ("capsule_capsule", _capsules, _capsules, capsule_capsule_distance, capsule_capsule),
    ("capsule_box", _capsules, _boxes, capsule_box_distance, capsule_box),
    ("box_box", _boxes, _boxes, box_box_distance, box_box),
)
"""Field of `Pairs`, what its two rows number, distance and separation of such a pair."""


def smallest_distance(bodies: list[PlacedShapes], pairs: Pairs) -> jax.Array:
    """Smallest signed distance (m) per lane over the pairs, `(lanes,)`; FAR without pairs. Negative is penetration."""
    shapes = _joined(bodies)
    result = jnp.full(shapes.starts.shape[-1:], FAR)
    for field, first, second, distance, _ in _KINDS:
        index = getattr(pairs, field)
        if index.shape[1]:
            measured = distance(*first(shapes, index[0]), *second(shapes, index[1]))
            result = jnp.minimum(result, jnp.min(measured, axis=0))
    return result


class Contact(NamedTuple):
    """The nearest pair of each lane; A and B as in `Separation`."""

    separation: Separation  # fields (lanes,), (3, lanes)
    bodies: jax.Array  # (2, lanes) int32 body of A and of B
    links: jax.Array  # (2, lanes) int32 link of each in its body


def nearest_contact(bodies: list[PlacedShapes], shapes: tuple[Shapes, ...], pairs: Pairs) -> Contact:
    """The pair with the smallest signed distance per lane; without pairs a distance of FAR and no normal.

    All pairs are measured, but only the nearest of each kind is looked at for its normal and points.
    """
    placed = materialise(_joined(bodies))
    lanes = placed.starts.shape[-1]
    owners = {}
    for kind, links in (("capsules", "capsule_links"), ("boxes", "box_links")):
        of_body = [np.full(getattr(s, links).shape[0], i, np.int32) for i, s in enumerate(shapes)]
        owners[kind] = jnp.asarray(np.concatenate(of_body)), jnp.concatenate([jnp.asarray(getattr(s, links)) for s in shapes])
    nothing = Separation(jnp.full((lanes,), FAR), *(jnp.zeros((3, lanes)) for _ in range(3)))
    best = Contact(nothing, jnp.zeros((2, lanes), jnp.int32), jnp.zeros((2, lanes), jnp.int32))
    for field, first, second, distance, separate in _KINDS:
        index = jnp.asarray(getattr(pairs, field))
        if not index.shape[1]:
            continue
        measured = materialise(distance(*first(placed, index[0]), *second(placed, index[1])))
        # Two minima: XLA's CPU argmin goes element by element.
        numbers = jnp.arange(index.shape[1], dtype=jnp.int32)[:, None]
        nearest = jnp.min(jnp.where(measured <= jnp.min(measured, axis=0), numbers, index.shape[1]), axis=0)
        nearest = jnp.minimum(nearest, index.shape[1] - 1)  # no distance is a number: the last pair
        sides = index[:, nearest]  # (2, lanes)

        def chosen(side: jax.Array, of_capsules: bool) -> list[jax.Array]:
            fields = ("starts", "ends", "radii") if of_capsules else ("centres", "rotations", "halves")
            arrays = [getattr(placed, name) for name in fields]
            at = [side.reshape((1,) * (a.ndim - 1) + (lanes,)) for a in arrays]
            return [jnp.take_along_axis(a, i, axis=-2)[..., 0, :] for a, i in zip(arrays, at, strict=True)]

        kinds = ["capsules" if get is _capsules else "boxes" for get in (first, second)]
        separation = separate(*(part for side, k in zip(sides, kinds, strict=True) for part in chosen(side, k == "capsules")))
        here = Contact(
            separation,
            jnp.stack([owners[k][0][side] for side, k in zip(sides, kinds, strict=True)]),
            jnp.stack([owners[k][1][side] for side, k in zip(sides, kinds, strict=True)]),
        )
        nearer = separation.distance < best.separation.distance
        best = jax.tree.map(lambda new, old, nearer=nearer: jnp.where(nearer, new, old), here, best)
    return best._replace(separation=materialise(best.separation))


# ------------------------------------------------------------------ host: reading shapes from a model


class Geom(NamedTuple):
    """A geom in the frame of a link: an end-to-end capsule or a box."""

    index: int
    link: int
    rotation: np.ndarray  # (3, 3) T_link_geom
    position: np.ndarray  # (3,)


def read_shapes(model: mujoco.MjModel, geoms: list[Geom]) -> tuple[Shapes, list[tuple[str, int]]]:
    """Shapes of the geoms, and for each its kind ("capsule" or "box") and position among its kind.

    A geom may be listed more than once: an object stands still at its start at one switch, at its goal at another.
    """
    capsules: list[tuple] = []
    boxes: list[tuple] = []
    places: list[tuple[str, int]] = []
    for geom in geoms:
        kind, size = int(model.geom_type[geom.index]), model.geom_size[geom.index]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            places.append(("box", len(boxes)))
            boxes.append((geom.position, geom.rotation, size.copy(), geom.link))
            continue
        half = geom.rotation[:, 2] * (size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0)
        places.append(("capsule", len(capsules)))
        capsules.append((geom.position - half, geom.position + half, size[0], geom.link))
    return (
        Shapes(
            starts=np.array([c[0] for c in capsules]).reshape(-1, 3).T,
            ends=np.array([c[1] for c in capsules]).reshape(-1, 3).T,
            radii=np.array([c[2] for c in capsules]),
            capsule_links=np.array([c[3] for c in capsules], dtype=np.int32),
            centres=np.array([b[0] for b in boxes]).reshape(-1, 3).T,
            rotations=np.moveaxis(np.array([b[1] for b in boxes]).reshape(-1, 3, 3), 0, 2),
            halves=np.array([b[2] for b in boxes]).reshape(-1, 3).T,
            box_links=np.array([b[3] for b in boxes], dtype=np.int32),
        ),
        places,
    )


def pair_lists(live: list[tuple[tuple[int, str, int], tuple[int, str, int]]], shapes: list[Shapes]) -> Pairs:
    """Pairs from (body, kind, position in the body) twice; a box of a capsule-box pair is put second."""
    capsule_start = np.cumsum([0, *[s.radii.shape[0] for s in shapes]])
    box_start = np.cumsum([0, *[s.box_links.shape[0] for s in shapes]])

    def at(entry: tuple[int, str, int]) -> int:
        body, kind, position = entry
        return int((capsule_start if kind == "capsule" else box_start)[body]) + position

    lists: dict[str, list[tuple[int, int]]] = {"capsule_capsule": [], "capsule_box": [], "box_box": []}
    for a, b in live:
        a, b = (b, a) if (a[1], b[1]) == ("box", "capsule") else (a, b)
        lists[f"{a[1]}_{b[1]}"].append((at(a), at(b)))
    return Pairs(**{name: np.array(pairs, dtype=np.int32).reshape(-1, 2).T for name, pairs in lists.items()})
