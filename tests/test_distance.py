"""Distances against C MuJoCo's `mj_geomDistance` (float64), derivatives against finite differences."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cgs_jax import distance

COUNT = 600
FAR = 10.0
# A box is a convex mesh here: MuJoCo's own routine for capsule and box reports centimetres of
# clearance for some capsules that pierce the box, its general one for convex meshes does not.
MODEL = """
<mujoco>
  <option ccd_iterations="500" ccd_tolerance="1e-10"/>
  <asset>
    <mesh name="a" vertex="-1 -1 -1  -1 -1 1  -1 1 -1  -1 1 1  1 -1 -1  1 -1 1  1 1 -1  1 1 1"/>
    <mesh name="b" vertex="-1 -1 -1  -1 -1 1  -1 1 -1  -1 1 1  1 -1 -1  1 -1 1  1 1 -1  1 1 1"/>
  </asset>
  <worldbody>
    <body mocap="true"><geom {a}/></body>
    <body mocap="true"><geom {b}/></body>
  </worldbody>
</mujoco>
"""


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform rotations (count, 3, 3), right-handed."""
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q *= np.sign(np.einsum("nii->ni", r))[:, None, :]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    out = np.zeros(9)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis / np.linalg.norm(axis), angle)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


class Poses:
    """Geoms of one type: centres (n, 3), rotations (n, 3, 3), MuJoCo sizes (n, 3)."""

    def __init__(self, kind: str, centres: np.ndarray, rotations: np.ndarray, sizes: np.ndarray):
        self.kind, self.centres, self.rotations, self.sizes = kind, centres, rotations, sizes

    def arguments(self, dtype=np.float32) -> tuple[jax.Array, ...]:
        """As the distance functions take them, trailing axis (n,)."""
        if self.kind == "box":
            parts = self.centres.T, np.moveaxis(self.rotations, 0, -1), self.sizes.T
        else:
            reach = self.rotations[:, :, 2] * (self.sizes[:, 1:2] if self.kind == "capsule" else 0.0)
            parts = (self.centres - reach).T, (self.centres + reach).T, self.sizes[:, 0]
        return tuple(jnp.asarray(part, dtype) for part in parts)


def random_poses(kind: str, rng: np.random.Generator, count: int, spread: float = 0.3) -> Poses:
    sizes = rng.uniform(0.02, 0.25, (count, 3))
    if kind != "box":
        sizes[:, 0] = rng.uniform(0.01, 0.08, count)
    return Poses(kind, rng.uniform(-spread, spread, (count, 3)), random_rotations(rng, count), sizes)


def mujoco_distances(a: Poses, b: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) and the segments between nearest points (n, 3), from a to b."""
    geoms = [
        f'type="mesh" mesh="{mesh}"' if poses.kind == "box" else f'type="{poses.kind}" size="0.1 0.1"'
        for mesh, poses in (("a", a), ("b", b))
    ]
    model = mujoco.MjModel.from_xml_string(MODEL.format(a=geoms[0], b=geoms[1]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    corners = np.sign(model.mesh_vert)
    distances, segments = np.zeros(len(a.centres)), np.zeros((len(a.centres), 6))
    for n in range(len(a.centres)):
        for geom, poses in enumerate((a, b)):
            model.geom_size[geom] = poses.sizes[n]
            model.geom_rbound[geom] = np.linalg.norm(poses.sizes[n]) + poses.sizes[n, 0]
            data.geom_xpos[geom] = poses.centres[n]
            data.geom_xmat[geom] = poses.rotations[n].ravel()
            vertices = slice(8 * geom, 8 * geom + 8)
            model.mesh_vert[vertices] = corners[vertices] * poses.sizes[n]
        distances[n] = mujoco.mj_geomDistance(model, data, 0, 1, FAR, segments[n])
    return distances, segments[:, 3:] - segments[:, :3]


PAIRS = [
    ("sphere", "sphere"),
    ("sphere", "capsule"),
    ("capsule", "capsule"),
    ("sphere", "box"),
    ("capsule", "box"),
    ("box", "box"),
]


def function_name(a: Poses, b: Poses) -> str:
    shape = {"sphere": "capsule", "capsule": "capsule", "box": "box"}
    return f"{shape[a.kind]}_{shape[b.kind]}"


@functools.cache
def compiled(name: str):
    return jax.jit(getattr(distance, name))


def verdict(a: Poses, b: Poses) -> np.ndarray:
    return np.asarray(compiled(function_name(a, b) + "_distance")(*a.arguments(), *b.arguments()), float)


def assert_agrees(a: Poses, b: Poses, apart: float = 1e-6, inside: float = 1e-6, sign_margin: float = 2e-7) -> None:
    """Float32 verdicts against MuJoCo: sign, distance apart (two boxes: a bound from below), depth inside (metres)."""
    truth, _ = mujoco_distances(a, b)
    ours = verdict(a, b)
    clear = np.abs(truth) > sign_margin
    np.testing.assert_array_equal(np.sign(ours[clear]), np.sign(truth[clear]))
    np.testing.assert_allclose(ours[truth <= 0], truth[truth <= 0], rtol=0, atol=inside)
    outside = truth > 0
    if a.kind == b.kind == "box":
        assert np.all(ours[outside] <= truth[outside] + apart)
        assert np.all(ours[outside] >= truth[outside] / np.sqrt(3) - apart)
    else:
        np.testing.assert_allclose(ours[outside], truth[outside], rtol=0, atol=apart)


def pushed_together(a: Poses, b: Poses, rng: np.random.Generator, margin: float) -> Poses:
    """`b` shifted along the shortest segment between the two, until the gap is uniform in +-margin."""
    distances, segments = mujoco_distances(a, b)
    gap = rng.uniform(-margin, margin, len(distances))
    move = segments * ((gap - distances) / np.maximum(distances, 1e-9))[:, None]
    return Poses(b.kind, b.centres + np.where((distances > 0.01)[:, None], move, 0.0), b.rotations, b.sizes)


@pytest.mark.parametrize("kind_a, kind_b", PAIRS)
def test_random_poses_agree_with_mujoco(kind_a, kind_b):
    rng = np.random.default_rng(1)
    assert_agrees(random_poses(kind_a, rng, COUNT), random_poses(kind_b, rng, COUNT))


@pytest.mark.parametrize("kind_a, kind_b", PAIRS)
def test_grazing_poses_agree_with_mujoco(kind_a, kind_b):
    rng = np.random.default_rng(2)
    a, b = random_poses(kind_a, rng, COUNT), random_poses(kind_b, rng, COUNT)
    assert_agrees(a, pushed_together(a, b, rng, margin=3e-3))


@pytest.mark.parametrize("kind_a, kind_b", PAIRS[2:])
def test_nearly_parallel_poses_agree_with_mujoco(kind_a, kind_b):
    rng = np.random.default_rng(3)
    a, b = random_poses(kind_a, rng, COUNT), random_poses(kind_b, rng, COUNT)
    for n, angle in enumerate(10.0 ** rng.uniform(-8, -1, COUNT)):
        b.rotations[n] = a.rotations[n] @ rotation_about(rng.normal(size=3), angle)
    assert_agrees(a, b)
    assert_agrees(a, pushed_together(a, b, rng, margin=1e-3))


def attained_along_an_axis(a: Poses, b: Poses, truth: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Which box pairs (n,) overlap or are nearest along one of their 15 axes: there the bound is the distance."""
    direction = segments / np.maximum(np.linalg.norm(segments, axis=1, keepdims=True), 1e-12)
    axes = [a.rotations[:, :, i] for i in range(3)] + [b.rotations[:, :, i] for i in range(3)]
    crossed = [np.cross(u, v) for u, v in itertools.product(axes[:3], axes[3:])]
    axes += [c / np.linalg.norm(c, axis=1, keepdims=True) for c in crossed]
    alignment = np.max([np.abs(np.sum(direction * axis, axis=1)) for axis in axes], axis=0)
    return (truth < 0) | (alignment > 1 - 1e-10)


def test_box_distance_is_exact_where_a_face_or_crossing_edges_attain_it():
    rng = np.random.default_rng(4)
    a, b = random_poses("box", rng, COUNT), random_poses("box", rng, COUNT)
    truth, segments = mujoco_distances(a, b)
    exact = attained_along_an_axis(a, b, truth, segments) & (truth > 1e-3)
    assert exact.sum() > COUNT / 10
    np.testing.assert_allclose(verdict(a, b)[exact], truth[exact], rtol=0, atol=1e-6)


def one(kind: str, centre=(0, 0, 0), axis=(0, 0, 1), angle=0.0, size=(0.1, 0.1, 0.1)) -> Poses:
    """One pose, as often as the other tests have poses: then all share the compiled programs."""
    rotation = rotation_about(np.asarray(axis, float), angle)
    return Poses(kind, *(np.repeat(np.array([part], float), COUNT, axis=0) for part in (centre, rotation, size)))


ACROSS = dict(axis=(0, 1, 0), angle=np.pi / 2)
THIN = (0.02, 0.1, 0.0)
CUBOID = (0.1, 0.2, 0.3)
# Two bodies and their distance by arithmetic (of two boxes: the bound).
DEGENERATE = {
    "coincident spheres": (one("sphere"), one("sphere"), -0.2),
    "coincident capsules": (one("capsule", size=THIN), one("capsule", size=THIN), -0.04),
    "crossing capsules": (one("capsule", size=THIN), one("capsule", size=THIN, **ACROSS), -0.04),
    "collinear capsules": (one("capsule", size=THIN), one("capsule", (0, 0, 0.5), size=THIN), 0.26),
    "parallel capsules": (one("capsule", size=THIN), one("capsule", (0.1, 0, 0.05), size=THIN), 0.06),
    "sphere on a capsule's axis": (one("sphere", (0, 0, 0.05)), one("capsule", size=THIN), -0.12),
    "sphere at a box's centre": (one("sphere"), one("box", size=CUBOID), -0.2),
    "sphere on a box's face": (one("sphere", (0.1, 0, 0)), one("box"), -0.1),
    "sphere on a box's corner": (one("sphere", (0.1, 0.1, 0.1)), one("box"), -0.1),
    "capsule through a box's centre": (one("capsule", size=(0.02, 0.4, 0)), one("box", size=CUBOID[::-1]), -0.22),
    "capsule along a face": (one("capsule", (0.2, 0, 0), size=THIN), one("box"), 0.08),
    "capsule on a face": (one("capsule", (0.1, 0, 0), size=THIN), one("box"), -0.02),
    "capsule along an edge": (one("capsule", (0.1, 0.1, 0), size=THIN), one("box"), -0.02),
    "capsule beside an edge": (one("capsule", (0.2, 0.3, 0.1), size=THIN), one("box"), np.hypot(0.1, 0.2) - 0.02),
    "coincident boxes": (one("box", size=CUBOID), one("box", size=CUBOID), -0.2),
    "coincident cubes": (one("box"), one("box"), -0.2),
    "stacked cubes": (one("box"), one("box", (0, 0, 0.3)), 0.1),
    "cubes corner to corner": (one("box"), one("box", (0.3, 0.3, 0.3)), 0.1),
    "cubes edge to edge": (one("box"), one("box", (0.3, 0.3, 0.0)), 0.1),
    "flat cubes turned": (one("box"), one("box", (0.1, 0.05, 0.25), angle=0.3), 0.05),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_poses_are_right_and_finite(case):
    a, b, expected = DEGENERATE[case]
    arguments = (*a.arguments(), *b.arguments())
    name = function_name(a, b)
    np.testing.assert_allclose(verdict(a, b), expected, rtol=0, atol=1e-6)
    separation = compiled(name)(*arguments)
    np.testing.assert_allclose(separation.distance, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(separation.normal, axis=0), 1, rtol=0, atol=1e-6)
    for leaf in (*separation, *compiled_gradient(name)(*arguments)):
        assert np.all(np.isfinite(leaf))


@functools.cache
def compiled_gradient(name: str):
    verdicts = getattr(distance, name + "_distance")
    return jax.jit(jax.grad(lambda *arguments: verdicts(*arguments).sum(), argnums=tuple(range(6))))


def separation_of(a: Poses, b: Poses):
    fields = compiled(function_name(a, b))(*a.arguments(), *b.arguments())
    return [np.asarray(field, float) for field in fields]


@pytest.mark.parametrize("kind_a, kind_b", PAIRS)
def test_separation_is_the_verdict_with_consistent_points(kind_a, kind_b):
    rng = np.random.default_rng(5)
    a, b = random_poses(kind_a, rng, COUNT, spread=0.2), random_poses(kind_b, rng, COUNT, spread=0.2)
    value, normal, point_a, point_b = separation_of(a, b)
    np.testing.assert_allclose(value, verdict(a, b), rtol=0, atol=2e-7)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, rtol=0, atol=1e-6)
    np.testing.assert_allclose(point_a + value * normal, point_b, rtol=0, atol=1e-6)
    # Both points lie on their surfaces; of two boxes apart, only where the bound is the distance.
    kept = np.ones(COUNT, bool)
    if kind_a == "box":
        kept = attained_along_an_axis(a, b, *mujoco_distances(a, b))
        assert kept.sum() > COUNT / 10
    zero = jnp.zeros(COUNT)
    for poses, point in ((a, point_a), (b, point_b)):
        point = jnp.asarray(point, jnp.float32)
        function = compiled("capsule_box_distance" if poses.kind == "box" else "capsule_capsule_distance")
        on_surface = np.asarray(function(point, point, zero, *poses.arguments()))
        np.testing.assert_allclose(on_surface[kept], 0, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind_a, kind_b", PAIRS)
def test_moving_out_along_the_normal_frees_the_pair(kind_a, kind_b):
    rng = np.random.default_rng(6)
    a, b = random_poses(kind_a, rng, COUNT, spread=0.1), random_poses(kind_b, rng, COUNT, spread=0.1)
    value, normal, _, _ = separation_of(a, b)
    inside = value < 0
    assert inside.sum() > 20
    freed = Poses(b.kind, b.centres + (np.where(inside, -value, 0.0) * normal).T, b.rotations, b.sizes)
    np.testing.assert_allclose(verdict(a, freed)[inside], 0, rtol=0, atol=1e-6)


def moved(motion, body, stretches):
    """A body's arguments after motion (9, n): shift, turn, growth. `stretches` is 1 if a segment may grow, else 0."""
    shift, (x, y, z), growth = motion[:3], motion[3:6], motion[6:]
    zero = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    # Second order of the exponential is all that central differences and first derivatives at zero can see.
    turn = jnp.eye(3)[:, :, None] + skew + 0.5 * jnp.einsum("ijn,jkn->ikn", skew, skew)
    if body[1].ndim == 3:
        centre, rotation, half = body
        return centre + shift, jnp.einsum("ijn,jkn->ikn", turn, rotation), half + growth
    start, end, radius = body
    start, end = (jnp.einsum("ijn,jn->in", turn, point) + shift for point in (start, end))
    return start, end + stretches * growth[1:2], radius + growth[0]


@functools.cache
def compiled_differences(name: str):
    """Gradient of the verdict and of the separation's distance, and values at steps (m, 18, n) of motion."""
    verdicts, separations = getattr(distance, name + "_distance"), getattr(distance, name)

    def values(function, motion, bodies, stretches):
        halves = motion[:9], motion[9:]
        return function(*(part for moving in zip(halves, bodies, stretches) for part in moved(*moving)))

    def measure(steps, bodies, stretches):
        zero = jnp.zeros(steps.shape[1:])
        gradients = [
            jax.grad(lambda motion, function=function: values(function, motion, bodies, stretches).sum())(zero)
            for function in (verdicts, lambda *arguments: separations(*arguments).distance)
        ]
        return *gradients, jax.lax.map(lambda motion: values(verdicts, motion, bodies, stretches), steps)

    return jax.jit(measure)


@pytest.mark.parametrize("kind_a, kind_b", PAIRS)
def test_derivatives_match_finite_differences(kind_a, kind_b):
    rng = np.random.default_rng(7)
    a, b = random_poses(kind_a, rng, COUNT, spread=0.2), random_poses(kind_b, rng, COUNT, spread=0.2)
    step = 1e-6
    units = np.eye(18)[:, :, None] * np.ones(COUNT)
    steps = step * np.concatenate([units, -units, 0 * units[:1]])
    # Pulling a sphere's coincident end points apart is a kink.
    stretches = [float(kind == "capsule") for kind in (kind_a, kind_b)]
    with jax.enable_x64(True):
        bodies = a.arguments(np.float64), b.arguments(np.float64)
        measured = compiled_differences(function_name(a, b))(steps, bodies, stretches)
        gradient, gradient_of_separation, values = (np.asarray(array) for array in measured)
    plus, minus, here = values[:18], values[18:36], values[36]
    differences, curvature = (plus - minus) / (2 * step), np.abs(plus + minus - 2 * here) / step
    smooth = curvature.max(axis=0) < 1e-2
    assert smooth.mean() > 0.9
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(gradient[:, smooth], differences[:, smooth], rtol=0, atol=1e-4)
    np.testing.assert_allclose(gradient_of_separation, gradient, rtol=0, atol=1e-9)


def test_trailing_axes_broadcast_and_map():
    rng = np.random.default_rng(8)
    capsules, boxes = random_poses("capsule", rng, 7), random_poses("box", rng, 5)
    lanes = [part[..., None, :] for part in capsules.arguments()]
    pairs = [part[..., :, None] for part in boxes.arguments()]
    grid = jax.jit(distance.capsule_box)(*lanes, *pairs)
    assert [field.shape for field in grid] == [(5, 7), (3, 5, 7), (3, 5, 7), (3, 5, 7)]
    of_one_box = [part[..., 2] for part in boxes.arguments()]
    for function in (distance.capsule_box_distance, lambda *arguments: distance.capsule_box(*arguments).distance):
        mapped = jax.jit(jax.vmap(function, in_axes=(-1, -1, -1, None, None, None)))
        values = mapped(*capsules.arguments(), *of_one_box)
        np.testing.assert_allclose(values, grid.distance[2], rtol=0, atol=1e-7)
