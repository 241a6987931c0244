"""Signed distances of spheres, capsules and boxes, batch last.

Every array has its component axes first and any broadcastable trailing axes after them, typically (pairs, lanes):
points (3, ...), rotations (3, 3, ...), radii (...), half sizes (3, ...); metres, one common (world) frame. A capsule is
two end points and a radius; a sphere is a capsule whose end points coincide. A box is a centre, a rotation (its columns
are the box's axes) and half sizes.

Distances are positive apart, negative in penetration. Each pair of primitives comes twice: `<pair>_distance` is the
verdict alone, a few nanoseconds per element, and `<pair>` is a `Separation` with normal and witness points. Derivatives
of a distance are those of the witness points along the normal (envelope theorem),

    d distance = normal . (velocity of point_b - velocity of point_a),

finite everywhere and exact wherever the distance is differentiable. Rotations must move within SO(3): the derivative
with respect to a single entry of a rotation matrix means nothing. The other fields of a `Separation` count as constants
under differentiation, and so does the normal in that formula: second derivatives are not those of the distance.

All arguments of a call have the same number of trailing axes. Arithmetic is written per component on (...) arrays: the
trailing axes vectorise, and no reduction stands in the way of fusion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

# Three components (...); an array (3, ...) serves too wherever one is read.
Vector = tuple[jax.Array, jax.Array, jax.Array] | jax.Array

# Below this, a divisor counts as zero: far under any length in metres or its square, far over float32's underflow.
TINY = 1e-30
# Stands for infinity where an infinity would breed NaNs.
LARGE = 1e30
# A segment whose projection is shorter than this (metres) is a point in that projection.
SHORT = 1e-6
# Two box edges whose directions have a smaller sine (squared) span no separating axis of their own.
PARALLEL_SINE_SQUARED = 1e-12
# An edge pair names the contact normal only where its sine (squared) allows well-conditioned witness points, and where
# it beats the best face by more than rounding (metres).
WITNESS_SINE_SQUARED = 1e-6
FACE_PREFERENCE = 1e-6
# A box edge whose direction has a smaller cosine to the normal lies flat on the supporting plane.
FLAT_COSINE = 1e-5
# Segments closer than this (metres) intersect: the difference of their points is rounding, not a direction.
INTERSECTION = 1e-7


class Separation(NamedTuple):
    """Signed distance (...), and where it is attained: unit `normal` (3, ...) from A to B, points (3, ...) on A and B.

    distance = normal . (point_b - point_a). World frame, metres.
    """

    distance: jax.Array
    normal: jax.Array
    point_a: jax.Array
    point_b: jax.Array


def _larger(u: jax.Array, v: jax.Array) -> jax.Array:
    """Maximum without the NaN rule of `jnp.maximum`: one machine instruction instead of several."""
    return jnp.where(u > v, u, v)


def _smaller(u: jax.Array, v: jax.Array) -> jax.Array:
    return jnp.where(u < v, u, v)


def _unit_interval(u: jax.Array) -> jax.Array:
    return _smaller(_larger(u, 0.0), 1.0)


def _sign(u: jax.Array) -> jax.Array:
    """+1 or -1, never 0."""
    return jnp.where(u < 0, -1.0, 1.0).astype(u.dtype)


def _subtract(u: Vector, v: Vector) -> Vector:
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


def _along(origin: Vector, length: jax.Array, direction: Vector) -> Vector:
    """origin + length * direction."""
    return tuple(o + length * d for o, d in zip(origin, direction))


def _dot(u: Vector, v: Vector) -> jax.Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u: Vector, v: Vector) -> Vector:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def _rotate(rotation: jax.Array, v: Vector) -> jax.Array:
    """rotation (3, 3, ...) times v, as one array (3, ...)."""
    return sum(rotation[:, i] * v[i] for i in range(3))


def _rotate_back(rotation: jax.Array, v: Vector) -> jax.Array:
    """Transpose of rotation (3, 3, ...) times v, as one array (3, ...)."""
    return sum(rotation[i] * v[i] for i in range(3))


def _select(condition: jax.Array, u: Vector, v: Vector) -> Vector:
    return tuple(jnp.where(condition, a, b) for a, b in zip(u, v))


def _one_hot(number: jax.Array) -> Vector:
    return tuple((number == i).astype(number.dtype) for i in range(3))


def _components(v: jax.Array) -> Vector:
    return v[0], v[1], v[2]


def _stack(v: Vector, shape: tuple[int, ...]) -> jax.Array:
    return jnp.stack([jnp.broadcast_to(component, shape) for component in v])


def materialise(values):
    """The same tree of arrays, computed once.

    XLA:CPU fuses a producer into each of its consumers and runs it again for each output and each row of a stacked one,
    which made the contacts below and their derivatives 20 to 500 times slower. It does not fuse across a loop, and
    unrolls one of a single trip; an `optimization_barrier` it drops. So: two trips of an identity that it cannot prove
    to be one.
    """

    def same(_, current):
        return jax.tree.map(lambda x: jnp.where(x < -LARGE, -LARGE, x), current)

    return jax.lax.fori_loop(0, 2, same, values)


def _largest(candidates) -> jax.Array:
    largest, *others = candidates
    for candidate in others:
        largest = _larger(largest, candidate)
    return largest


def _axis_number(separations: list[jax.Array], witnesses: list) -> jax.Array:
    """Number (...), as a float, of the largest separation whose `witnesses` entry, a bool or (...), allows it.

    A later axis must beat the best before it by more than rounding: faces come first and make better contacts.
    """
    best, number = separations[0], jnp.zeros_like(separations[0])
    for candidate, (separation, witness) in enumerate(zip(separations[1:], witnesses[1:]), start=1):
        better = (separation > best + FACE_PREFERENCE) & witness
        best, number = jnp.where(better, separation, best), jnp.where(better, float(candidate), number)
    return number


def _separation(distance: jax.Array, normal: Vector, point_a: Vector, point_b: Vector) -> Separation:
    shape = jnp.shape(distance)
    return Separation(distance, _stack(normal, shape), _stack(point_a, shape), _stack(point_b, shape))


def _constant_contact(separation: Separation, rate: jax.Array) -> Separation:
    """Tangent of a separation: the distance changes at `rate`, all else counts as constant."""
    return Separation(rate, *(jnp.zeros_like(field) for field in separation[1:]))


def _segment_velocity(parameter: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Velocity (3, ...) of the material point at `parameter` of a segment, given those of its end points."""
    return start + parameter * (end - start)


def _box_velocity(point: jax.Array, centre: jax.Array, rotation: jax.Array, centre_rate, rotation_rate) -> jax.Array:
    """Velocity (3, ...) of the material point of a box that is at `point`."""
    local = _rotate_back(rotation, _subtract(point, centre))
    return centre_rate + sum(rotation_rate[:, i] * local[i] for i in range(3))


def _box_growth(normal: jax.Array, rotation: jax.Array, half_rate: jax.Array) -> jax.Array:
    """Rate (...) at which growing half sizes push a box's supporting plane out along `normal`."""
    return sum(jnp.abs(n) * rate for n, rate in zip(_rotate_back(rotation, normal), half_rate))


# Capsule and capsule: nearest points of two segments.


def _nearest_on_segments(a0: Vector, a_span: Vector, b0: Vector, b_span: Vector) -> tuple[jax.Array, jax.Array]:
    """Parameters (...) in [0, 1] of the nearest points of two segments (Ericson, Real-Time Collision Detection, 5.1.9).

    Nearly parallel segments have an ill-conditioned first parameter, but the others are projections of a point that is
    then fixed, so the distance stays accurate to rounding.
    """
    offset = _subtract(a0, b0)
    a_square, b_square, ab = _dot(a_span, a_span), _dot(b_span, b_span), _dot(a_span, b_span)
    a_offset, b_offset = _dot(a_span, offset), _dot(b_span, offset)
    determinant = a_square * b_square - ab * ab
    s = _unit_interval((ab * b_offset - a_offset * b_square) / _larger(determinant, TINY))
    t = _unit_interval((ab * s + b_offset) / _larger(b_square, TINY))
    s = _unit_interval((ab * t - a_offset) / _larger(a_square, TINY))
    return s, t


def _perpendicular(u: Vector, v: Vector) -> Vector:
    """A unit vector perpendicular to both; to the longer one where they are parallel; anything where both vanish."""
    longer = _select(_dot(u, u) > _dot(v, v), u, v)
    square = _dot(longer, longer)
    zero, one = jnp.zeros_like(square), jnp.ones_like(square)
    x, y, z = longer
    across = _select(x * x < 0.5 * square, (zero, z, -y), (-z, zero, x))
    both = _cross(u, v)
    w = _select(_dot(both, both) > 1e-8 * square * square, both, across)
    w_square = _dot(w, w)
    scale = jax.lax.rsqrt(_larger(w_square, TINY))
    return _select(w_square > TINY, tuple(scale * component for component in w), (zero, zero, one))


def _capsule_capsule_core(a0, a1, b0, b1) -> tuple[jax.Array, jax.Array, Vector, Vector, tuple[Vector, Vector]]:
    """Parameters of the nearest points of the two segments, that point of A, the gap from it to B's, both spans."""
    a0, b0 = _components(a0), _components(b0)
    a_span, b_span = _subtract(_components(a1), a0), _subtract(_components(b1), b0)
    s, t = _nearest_on_segments(a0, a_span, b0, b_span)
    point = _along(a0, s, a_span)
    return s, t, point, _subtract(_along(b0, t, b_span), point), (a_span, b_span)


def _capsule_capsule_contact(a0, a1, ra, b0, b1, rb) -> tuple[Separation, jax.Array, jax.Array]:
    s, t, point, gap, (a_span, b_span) = _capsule_capsule_core(a0, a1, b0, b1)
    square = _dot(gap, gap)
    length = jnp.sqrt(square)
    apart = length > INTERSECTION
    scale = 1.0 / jnp.where(apart, length, 1.0)
    normal = _select(apart, tuple(scale * g for g in gap), _perpendicular(a_span, b_span))
    distance = length - ra - rb
    return _separation(distance, normal, _along(point, ra, normal), _along(point, length - rb, normal)), s, t


def _capsule_capsule_rate(contact: tuple[Separation, jax.Array, jax.Array], rates) -> jax.Array:
    separation, s, t = contact
    a0, a1, ra, b0, b1, rb = rates
    velocity = _segment_velocity(t, b0, b1) - _segment_velocity(s, a0, a1)
    return _dot(separation.normal, velocity) - ra - rb


@jax.custom_jvp
def capsule_capsule_distance(
    a0: jax.Array, a1: jax.Array, ra: jax.Array, b0: jax.Array, b1: jax.Array, rb: jax.Array
) -> jax.Array:
    """Signed distance (...) of two capsules, exact also in penetration (minus the least push apart)."""
    _, _, _, gap, _ = _capsule_capsule_core(a0, a1, b0, b1)
    return jnp.sqrt(_dot(gap, gap)) - ra - rb


@capsule_capsule_distance.defjvp
def _(primals, tangents):
    contact = _capsule_capsule_contact(*primals)
    return contact[0].distance, _capsule_capsule_rate(contact, tangents)


@jax.custom_jvp
def capsule_capsule(
    a0: jax.Array, a1: jax.Array, ra: jax.Array, b0: jax.Array, b1: jax.Array, rb: jax.Array
) -> Separation:
    """Separation of two capsules. Where the segments intersect, the normal is perpendicular to both of them."""
    return _capsule_capsule_contact(a0, a1, ra, b0, b1, rb)[0]


@capsule_capsule.defjvp
def _(primals, tangents):
    contact = _capsule_capsule_contact(*primals)
    return contact[0], _constant_contact(contact[0], _capsule_capsule_rate(contact, tangents))


# Capsule and box: a segment against a box, in the box's frame.


def _nearest_to_box(start: Vector, span: Vector, half: Vector) -> jax.Array:
    """Parameter (...) in [0, 1] where a segment is nearest to a box centred at the origin; exact, without iteration.

    The squared distance is convex in the parameter, its derivative piecewise linear with breaks where the segment
    crosses a face's plane. Among the breaks (moved into [0, 1]) and the ends, those nearest to the root on either side
    bracket a linear piece. Where the distance is constant (segment along a face) this is the middle of that stretch.
    """
    zero = jnp.zeros_like(start[0] + half[0])
    parameters = [zero, zero + 1.0]
    for x, d, h in zip(start, span, half):
        inverse = 1.0 / jnp.where(jnp.abs(d) > TINY, d, TINY)
        parameters += [_unit_interval((h - x) * inverse), _unit_interval((-h - x) * inverse)]

    # Where no slope has one of the two signs, the minimum is at an end: low == high, and their slopes do not matter.
    low, low_slope, high, high_slope = zero, zero - LARGE, zero + 1.0, zero + LARGE
    for t in parameters:
        slope = 0.0
        for x, d, h in zip(start, span, half):
            position = x + t * d
            slope = slope + d * (position - _larger(_smaller(position, h), -h))
        before, after = slope <= 0, slope >= 0
        low = _larger(low, jnp.where(before, t, 0.0))
        high = _smaller(high, jnp.where(after, t, 1.0))
        low_slope = _larger(low_slope, jnp.where(before, slope, -LARGE))
        high_slope = _smaller(high_slope, jnp.where(after, slope, LARGE))
    rise = high_slope - low_slope
    fraction = jnp.where(rise > TINY, -low_slope / _larger(rise, TINY), 0.5)
    return _unit_interval(low + fraction * (high - low))


def _separations_of_segment(start: Vector, span: Vector, half: Vector) -> list[jax.Array]:
    """Separation (...) of a segment and a box centred at the origin along six axes: box faces, then span x box axis.

    Their maximum is negative exactly where the segment enters the box, and then minus the least push that frees it: the
    faces of the Minkowski difference are the box's own and those spanned by the segment and one of its edges.
    """
    middle = _along(start, 0.5, span)
    separations = [jnp.abs(x) - h - 0.5 * jnp.abs(d) for x, h, d in zip(middle, half, span)]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        square = span[j] * span[j] + span[k] * span[k]
        reach = half[j] * jnp.abs(span[k]) + half[k] * jnp.abs(span[j])
        excess = jnp.abs(middle[j] * span[k] - middle[k] * span[j]) - reach
        separations.append(jnp.where(square > SHORT * SHORT, excess / jnp.sqrt(_larger(square, TINY)), -LARGE))
    return separations


def _deepest_in_box(number: jax.Array, start: Vector, span: Vector, half: Vector) -> tuple[Vector, jax.Array]:
    """Outward normal of the box along axis `number` of `_separations_of_segment`, and where on the segment it pushes.

    The latter is the parameter (...) in [0, 1] of the point from which the depth along that normal is measured.
    """
    middle = _along(start, 0.5, span)
    is_face = number < 3
    hot = _one_hot(jnp.where(is_face, number, number - 3))
    normal = _select(is_face, hot, _cross(span, hot))
    scale = _sign(_dot(normal, middle)) / jnp.sqrt(_larger(_dot(normal, normal), TINY))
    normal = tuple(scale * n for n in normal)

    descent = _dot(normal, span)
    flat = jnp.abs(descent) < FLAT_COSINE * jnp.sqrt(_dot(span, span))
    deepest = jnp.where(flat, 0.5, jnp.where(descent > 0, 0.0, 1.0))
    # Across an edge of the box: where, seen along that edge, the segment passes the edge.
    seen = tuple(d * (1 - component) for d, component in zip(span, hot))
    to_edge = tuple(_sign(n) * h - x for n, h, x in zip(normal, half, start))
    passing = _unit_interval(_dot(to_edge, seen) / _larger(_dot(seen, seen), TINY))
    return normal, jnp.where(is_face, deepest, passing)


def _segment_in_box_frame(a0, a1, centre, rotation) -> tuple[jax.Array, jax.Array]:
    """Start and span (3, ...) of a segment in the box's frame."""
    return _rotate_back(rotation, a0 - centre), _rotate_back(rotation, a1 - a0)


def _gap_to_box(point: Vector, half: Vector) -> Vector:
    """From `point` to the nearest point of a box centred at the origin."""
    return tuple(_larger(_smaller(x, h), -h) - x for x, h in zip(point, half))


def _capsule_box_contact(a0, a1, ra, centre, rotation, half) -> tuple[Separation, jax.Array]:
    half = _components(half)
    start, span = materialise(_segment_in_box_frame(a0, a1, centre, rotation))
    separations = _separations_of_segment(start, span, half)
    nearest, depth, number = materialise(
        (_nearest_to_box(start, span, half), _largest(separations), _axis_number(separations, [True] * 6))
    )
    gap = _gap_to_box(_along(start, nearest, span), half)
    length = jnp.sqrt(_dot(gap, gap))
    apart = length > INTERSECTION
    scale = 1.0 / jnp.where(apart, length, 1.0)
    outward, deepest = _deepest_in_box(number, start, span, half)
    normal = _select(apart, tuple(scale * g for g in gap), tuple(-n for n in outward))
    core, parameter = jnp.where(apart, length, depth), jnp.where(apart, nearest, deepest)
    normal, core, parameter = materialise((normal, core, parameter))
    normal = _rotate(rotation, normal)
    point = a0 + parameter * (a1 - a0)
    distance = core - ra
    normal = jnp.broadcast_to(normal, (3, *distance.shape))
    return Separation(distance, normal, point + ra * normal, point + core * normal), parameter


def _capsule_box_rate(contact: tuple[Separation, jax.Array], primals, rates) -> jax.Array:
    separation, parameter = contact
    _, _, _, centre, rotation, _ = primals
    a0_rate, a1_rate, ra_rate, centre_rate, rotation_rate, half_rate = rates
    velocity = _box_velocity(separation.point_b, centre, rotation, centre_rate, rotation_rate)
    velocity = velocity - _segment_velocity(parameter, a0_rate, a1_rate)
    return _dot(separation.normal, velocity) - ra_rate - _box_growth(separation.normal, rotation, half_rate)


@jax.custom_jvp
def capsule_box_distance(
    a0: jax.Array, a1: jax.Array, ra: jax.Array, centre: jax.Array, rotation: jax.Array, half: jax.Array
) -> jax.Array:
    """Signed distance (...) of a capsule and a box, exact also in penetration (minus the least push apart)."""
    start, span = _segment_in_box_frame(a0, a1, centre, rotation)
    half = _components(half)
    gap = _gap_to_box(_along(start, _nearest_to_box(start, span, half), span), half)
    length = jnp.sqrt(_dot(gap, gap))
    depth = _largest(_separations_of_segment(start, span, half))
    return jnp.where(length > INTERSECTION, length, depth) - ra


@capsule_box_distance.defjvp
def _(primals, tangents):
    contact = _capsule_box_contact(*primals)
    return contact[0].distance, _capsule_box_rate(contact, primals, tangents)


@jax.custom_jvp
def capsule_box(
    a0: jax.Array, a1: jax.Array, ra: jax.Array, centre: jax.Array, rotation: jax.Array, half: jax.Array
) -> Separation:
    """Separation of a capsule (A) and a box (B)."""
    return _capsule_box_contact(a0, a1, ra, centre, rotation, half)[0]


@capsule_box.defjvp
def _(primals, tangents):
    contact = _capsule_box_contact(*primals)
    return contact[0], _constant_contact(contact[0], _capsule_box_rate(contact, primals, tangents))


# Box and box: separating axes, in the frame of box A.


def _boxes_in_first_frame(centre_a, rotation_a, centre_b, rotation_b) -> tuple[jax.Array, jax.Array]:
    """Offset (3, ...) of B's centre from A's, and B's axes (3 axes, 3 components, ...), in A's frame."""
    axes_b = sum(rotation_a[i][None] * rotation_b[i][:, None] for i in range(3))
    return _rotate_back(rotation_a, centre_b - centre_a), axes_b


def _face_separations(offset: jax.Array, axes_b: jax.Array, half_a: jax.Array, half_b: jax.Array) -> list[jax.Array]:
    """Separations (...) along A's three face normals, then along B's."""
    separations = []
    for i in range(3):
        reach = half_a[i] + sum(half_b[k] * jnp.abs(axes_b[k][i]) for k in range(3))
        separations.append(jnp.abs(offset[i]) - reach)
    for k in range(3):
        reach = half_b[k] + sum(half_a[i] * jnp.abs(axes_b[k][i]) for i in range(3))
        separations.append(jnp.abs(_dot(offset, axes_b[k])) - reach)
    return separations


def _edge_separations(
    offset: jax.Array, axes_b: jax.Array, half_a: jax.Array, half_b: jax.Array
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Separations (...) along axis i of A x axis k of B, i slowest, and the squared sine between the two.

    The cross product is normalised and both boxes are projected on what came out: however nearly parallel the edges, it
    is a true direction and its separation a true bound. (The usual cofactors of the relative rotation lose that.)
    """
    separations, sines = [], []
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for k in range(3):
            n_p, n_q = -axes_b[k][q], axes_b[k][p]
            square = n_p * n_p + n_q * n_q
            excess = jnp.abs(offset[p] * n_p + offset[q] * n_q) - half_a[p] * jnp.abs(n_p) - half_a[q] * jnp.abs(n_q)
            for other in ((k + 1) % 3, (k + 2) % 3):
                excess = excess - half_b[other] * jnp.abs(axes_b[other][p] * n_p + axes_b[other][q] * n_q)
            crossing = square > PARALLEL_SINE_SQUARED
            separations.append(jnp.where(crossing, excess / jnp.sqrt(_larger(square, TINY)), -LARGE))
            sines.append(square)
    return separations, sines


def _half_toward(cosine: jax.Array, half: jax.Array) -> jax.Array:
    """Coordinate (...) along one box axis of the support point; the middle where the axis lies in the plane."""
    return jnp.where(jnp.abs(cosine) < FLAT_COSINE, 0.0, _sign(cosine) * half)


def _box_box_contact(centre_a, rotation_a, half_a, centre_b, rotation_b, half_b) -> Separation:
    offset, axes_b = materialise(_boxes_in_first_frame(centre_a, rotation_a, centre_b, rotation_b))
    faces = _face_separations(offset, axes_b, half_a, half_b)
    edges, sines = _edge_separations(offset, axes_b, half_a, half_b)
    witnesses = [True] * 6 + [square > WITNESS_SINE_SQUARED for square in sines]
    bound, number = materialise((_largest(faces + edges), _axis_number(faces + edges, witnesses)))

    of_a, of_b = number < 3, (number >= 3) & (number < 6)
    edge_a = _one_hot(jnp.where(of_a, number, jnp.floor((number - 6) / 3)))
    hot_b = _one_hot(jnp.where(of_b, number - 3, jnp.mod(number - 6, 3)))
    edge_b = materialise(sum(hot * axis for hot, axis in zip(hot_b, axes_b)))
    normal = _select(of_a, edge_a, _select(of_b, edge_b, _cross(edge_a, edge_b)))
    scale = _sign(_dot(normal, offset)) / jnp.sqrt(_larger(_dot(normal, normal), TINY))
    normal = materialise(tuple(scale * n for n in normal))

    support_a = tuple(_half_toward(n, h) for n, h in zip(normal, half_a))
    corner = [_half_toward(-_dot(axis, normal), h) for axis, h in zip(axes_b, half_b)]
    support_b = materialise(offset + sum(c * axis for c, axis in zip(corner, axes_b)))
    # On an edge pair both supports are mid-edge: slide along B's edge until the two lines are nearest each other.
    crosswise = _cross(edge_a, normal)
    sideways = _dot(crosswise, edge_b)
    slide = -_dot(crosswise, _subtract(support_b, support_a)) / jnp.where(sideways == 0, 1.0, sideways)
    slide = jnp.where(of_a, 0.0, slide)
    point_b = _select(of_b, _along(support_a, bound, normal), _along(support_b, slide, edge_b))
    normal = _rotate(rotation_a, normal)
    point_b = centre_a + _rotate(rotation_a, materialise(point_b))
    return Separation(bound, normal, point_b - bound * normal, point_b)


def _box_box_rate(separation: Separation, primals, rates) -> jax.Array:
    centre_a, rotation_a, _, centre_b, rotation_b, _ = primals
    centre_a_rate, rotation_a_rate, half_a_rate, centre_b_rate, rotation_b_rate, half_b_rate = rates
    velocity = _box_velocity(separation.point_b, centre_b, rotation_b, centre_b_rate, rotation_b_rate)
    velocity = velocity - _box_velocity(separation.point_a, centre_a, rotation_a, centre_a_rate, rotation_a_rate)
    growth = _box_growth(separation.normal, rotation_a, half_a_rate)
    return _dot(separation.normal, velocity) - growth - _box_growth(separation.normal, rotation_b, half_b_rate)


@jax.custom_jvp
def box_box_distance(
    centre_a: jax.Array,
    rotation_a: jax.Array,
    half_a: jax.Array,
    centre_b: jax.Array,
    rotation_b: jax.Array,
    half_b: jax.Array,
) -> jax.Array:
    """Largest separation (...) of two boxes over the 15 separating axes (Gottschalk, Lin and Manocha, OBBTree, 1996).

    Exact in sign, and in penetration (minus the least push apart). Apart it is a lower bound of the distance: exact
    where a face or a pair of crossing edges attains it, too small where the nearest features are a corner and an edge,
    two corners, or parallel edges.
    """
    offset, axes_b = _boxes_in_first_frame(centre_a, rotation_a, centre_b, rotation_b)
    return _largest(
        _face_separations(offset, axes_b, half_a, half_b) + _edge_separations(offset, axes_b, half_a, half_b)[0]
    )


@box_box_distance.defjvp
def _(primals, tangents):
    separation = _box_box_contact(*primals)
    return separation.distance, _box_box_rate(separation, primals, tangents)


@jax.custom_jvp
def box_box(
    centre_a: jax.Array,
    rotation_a: jax.Array,
    half_a: jax.Array,
    centre_b: jax.Array,
    rotation_b: jax.Array,
    half_b: jax.Array,
) -> Separation:
    """Separation of two boxes along the best of the 15 separating axes; see `box_box_distance` for what that means.

    Where the distance is a lower bound, the points lie on the supporting planes or edge lines, which may be beyond the
    ends of the surfaces: they are what the derivative of that bound needs.
    """
    return _box_box_contact(centre_a, rotation_a, half_a, centre_b, rotation_b, half_b)


@box_box.defjvp
def _(primals, tangents):
    separation = _box_box_contact(*primals)
    return separation, _constant_contact(separation, _box_box_rate(separation, primals, tangents))
