"""Coverage against manifolds whose measure is known."""

import gantry
import numpy as np
import pytest

from cgs_jax.coverage import (
    Cell,
    CoverageGain,
    bootstrap_interval,
    cell_indices,
    cover_radius,
    duplicate_share,
    fit_cells,
    limit_share,
    projected_coverage,
    ratio_of_means,
    reference_fill,
)
from cgs_jax.errors import InputError


def sphere(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def disc(count, centre, radius=1.0, seed=0):
    rng = np.random.default_rng(seed)
    angle, r = rng.uniform(0, 2 * np.pi, count), radius * np.sqrt(rng.random(count))
    return np.array(centre) + np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def rotations(count, seed=0):
    quat = np.random.default_rng(seed).normal(size=(count, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return np.concatenate([np.zeros((count, 3)), quat], axis=1)


def test_sphere_fills_the_cells_that_it_crosses():
    """A cell meets the unit sphere exactly when its nearest point is inside and its farthest outside."""
    size = 0.2
    low = size * np.stack(np.meshgrid(*[np.arange(-6, 7) - 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = np.linalg.norm(np.clip(0.0, low, low + size), axis=1)
    farthest = np.linalg.norm(np.maximum(np.abs(low), np.abs(low + size)), axis=1)
    crossed = int(((nearest < 1) & (farthest > 1)).sum())
    found = projected_coverage(sphere(200_000), Cell(joint=size))
    assert 0.97 * crossed < found <= crossed


def test_torus_fills_as_many_cells_as_chance_says():
    """n uniform samples leave each of m equal cells empty with probability (1 - 1/m)^n."""
    per_side, count = 30, 700
    angles = np.random.default_rng(1).uniform(0, 2 * np.pi, (count, 2))
    cells = per_side**2
    expected = cells * (1 - (1 - 1 / cells) ** count)
    variance = cells * (cells - 1) * (1 - 2 / cells) ** count + cells * (1 - 1 / cells) ** count
    variance -= cells**2 * (1 - 1 / cells) ** (2 * count)
    found = projected_coverage(angles, Cell(joint=2 * np.pi / per_side))
    assert abs(found - expected) < 4 * np.sqrt(variance)


def test_missing_one_of_two_discs_shows_in_both_measures():
    """With the second disc left out, half the cells are empty and its far edge is a centre distance away."""
    both = np.concatenate([disc(20_000, (0, 0)), disc(20_000, (5, 0), seed=1)])
    one = disc(20_000, (0, 0), seed=2)
    assert reference_fill(one, both, Cell(joint=0.25)) == pytest.approx(0.5, abs=0.03)
    assert cover_radius(one, both).maximum == pytest.approx(5.0, abs=0.05)
    inside = disc(20_000, (0, 0), seed=3)
    assert cover_radius(one, inside).maximum < 0.1


def test_wedge_on_a_lattice_has_the_lattice_radius():
    """No point inside a square lattice is further than spacing / sqrt(2) from it; the middles of squares are."""
    spacing, alpha = 0.05, 0.4
    rng = np.random.default_rng(0)
    box = rng.uniform([0, -1], [1, 1], (200_000, 2))
    wedge = box[np.abs(box[:, 1]) <= box[:, 0] * np.tan(alpha)]
    axes = np.arange(0, 1 + spacing / 2, spacing), np.arange(-0.5, 0.5 + spacing / 2, spacing)
    lattice = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    radius = cover_radius(lattice, wedge)
    assert 0.98 * spacing / np.sqrt(2) < radius.maximum <= spacing / np.sqrt(2) * (1 + 1e-9)
    # The median distance to the nearest lattice point: a disc of half the square's area.
    assert radius.quantiles[0.5] == pytest.approx(spacing / np.sqrt(2 * np.pi), rel=0.02)
    # The wedge's area over the cells', and its two slanted edges and one upright edge cut some cells.
    size = 0.02
    area = np.tan(alpha)
    found = projected_coverage(wedge, Cell(joint=size))
    cut = (2 * (1 + np.tan(alpha)) + 2 * np.tan(alpha)) / size
    assert area / size**2 < found < area / size**2 + cut


def test_rotations_fill_every_cell_and_the_sign_does_not_matter():
    poses = rotations(60_000)
    cell = Cell(rotation=np.pi / 7)
    assert projected_coverage(poses, cell) == 4 * 7**3
    flipped = poses * np.array([1, 1, 1, -1, -1, -1, -1])
    np.testing.assert_array_equal(cell_indices(poses, cell), cell_indices(flipped, cell))


def test_rotation_cells_have_the_stated_share_of_the_volume():
    """The density 1 / (1 + |u|^2)^2 of central projection times the stretch of atan, over the middle's value."""
    counts = np.unique(cell_indices(rotations(150_000), Cell(rotation=np.pi / 9)), axis=0, return_counts=True)
    indices, counts = counts[0][:, 4:], counts[1]
    tangent = np.tan((indices + 0.5) * np.pi / 18 - np.pi / 4)
    weight = (1 + tangent**2).prod(axis=1) / (1 + (tangent**2).sum(axis=1)) ** 2
    assert weight.max() / weight.min() < 1 / 0.44
    expected = weight / weight.sum() * 150_000
    assert len(counts) == 4 * 9**3
    # The formula at a cell's middle is within 2 % of the cell's mean; the rest is Poisson noise.
    assert np.abs((counts - expected) / np.sqrt(expected + (0.02 * expected) ** 2)).max() < 5


def test_turning_about_one_axis_crosses_cells_of_the_stated_angle():
    angle = np.linspace(-np.pi / 2 + 1e-6, np.pi / 2 - 1e-6, 2001)
    poses = np.zeros((2001, 7))
    poses[:, 3], poses[:, 5] = np.cos(angle / 2), np.sin(angle / 2)
    index = cell_indices(poses, Cell(rotation=np.pi / 9))
    np.testing.assert_array_equal(index[:, 5], np.floor((angle + np.pi / 2) / (np.pi / 9)))


def test_what_holds_within_a_tolerance_lies_in_the_cells_of_what_holds_exactly():
    """Upside down on a table, turned by any angle: one dimension, of which noise makes no others."""
    angle = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 50_000)
    exact = np.zeros((len(angle), 7))
    exact[:, 4], exact[:, 5] = np.cos(angle / 2), np.sin(angle / 2)
    noisy = exact + np.random.default_rng(1).normal(scale=1e-6, size=exact.shape)
    noisy[:, 3:] /= np.linalg.norm(noisy[:, 3:], axis=1, keepdims=True)
    cell = Cell(position=0.01, rotation=0.1)
    count = projected_coverage(exact, cell)
    assert count == pytest.approx(2.0 * np.pi / 0.1, rel=0.05)
    assert projected_coverage(noisy, cell) <= count + 2


def test_cover_radius_of_rotations_is_the_angle():
    """Samples every 0.2 rad about z: the farthest rotation is 0.1 rad away, across half a turn and both signs too."""

    def turns(angle):
        poses = np.zeros((len(angle), 7))
        poses[:, 3], poses[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
        return poses

    samples = turns(np.arange(0, 2 * np.pi, np.pi / 15))
    samples[::2, 3:] *= -1
    radius = cover_radius(samples, turns(np.linspace(-np.pi, np.pi, 9001)), rotation_length=0.5)
    assert radius.maximum == pytest.approx(0.5 * np.pi / 30, rel=1e-3)
    shifted = samples.copy()
    shifted[:, 0] = 0.3
    assert cover_radius(shifted, samples).maximum == pytest.approx(0.3)


def test_cells_fitted_to_a_reference_are_a_fifth_to_three_fifths_full():
    qpos, t, _ = gantry.valid(1200)
    samples, reference = gantry.sample_set(qpos, t).select(slice(120)), gantry.sample_set(qpos, t)
    fitted = fit_cells(samples, reference)
    assert set(fitted) == {"q_1", "q_2", "t"}
    for found in fitted.values():
        assert 0.2 <= found.fill <= 0.6
    cells = {name: found.cell for name, found in fitted.items()}
    assert reference_fill(samples, reference, cells) == {name: found.fill for name, found in fitted.items()}
    counts = projected_coverage(samples, cells)
    assert all(0 < counts[name] <= 120 for name in counts)
    few = fit_cells(sphere(10), sphere(10, seed=0))[""]
    assert few.fill == 1.0  # the same points can only be the same


def test_coverage_by_variable_tells_poses_from_configurations():
    qpos, t, _ = gantry.valid(50)
    samples = gantry.sample_set(qpos, t)
    counts = projected_coverage(samples, Cell())
    assert list(counts) == ["q_1", "q_2", "t"]
    assert counts == projected_coverage(dict(samples.variables), Cell())
    assert counts["q_1"] == len(np.unique(np.rint(samples["q_1"] / 0.5), axis=0))
    assert projected_coverage(samples.select([]), Cell()) == {"q_1": 0, "q_2": 0, "t": 0}


def test_bootstrap_interval_covers_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = 0
    for seed in range(100):
        low, high = bootstrap_interval(rng.normal(3.0, 1.0, 30), resamples=300, seed=seed)
        covered += low <= 3.0 <= high
    assert 86 <= covered <= 99


def test_bootstrap_of_a_ratio_and_degenerate_data():
    numerator = np.array([2.0, 2.2, 1.8, 2.1, 1.9])
    low, high = bootstrap_interval(numerator, numerator / 2, statistic=ratio_of_means, paired=True)
    assert low == pytest.approx(2.0) and high == pytest.approx(2.0)
    low, high = bootstrap_interval(numerator, numerator / 2, statistic=ratio_of_means)
    assert low < 2.0 < high
    assert bootstrap_interval([4.0, 4.0, 4.0]) == (4.0, 4.0)
    assert bootstrap_interval([5.0]) == (5.0, 5.0)
    assert bootstrap_interval(numerator, seed=3) == bootstrap_interval(numerator, seed=3)
    with pytest.raises(InputError, match="empty or non-finite"):
        bootstrap_interval([])
    with pytest.raises(InputError, match="paired samples of 2, 3"):
        bootstrap_interval([1, 2.0], [1, 2, 3.0], paired=True)


def test_limit_share():
    q = np.array([[0.0, 0.0], [0.9995, 0.0], [0.5, -2.0], [0.5, 0.5]])
    assert limit_share(q, np.array([-1, -2.0]), np.array([1, 2.0]), 1e-3) == 0.5
    assert limit_share(q, np.array([-np.inf] * 2), np.array([np.inf] * 2), 1e-3) == 0.0
    assert limit_share(np.zeros((0, 2)), np.zeros(2), np.ones(2), 1e-3) == 0.0


def test_coverage_gain_counts_the_first_in_each_cell_over_the_latest_samples():
    gain = CoverageGain({"q": "configuration", "p": "pose"}, Cell(), window=4)
    here, far = np.array([0, 0, 0, 1, 0, 0, 0.0]), np.array([9, 0, 0, 1, 0, 0, 0.0])
    assert gain.share == 1.0
    gain.add({"q": np.array([[0.1], [0.2], [3.1]]), "p": np.stack([here, here, far])})
    assert gain.share == 3 / 4  # three samples: (new, old, new) after one that has not been drawn
    gain.add({"q": np.array([[0.15], [3.2]]), "p": np.stack([far, here])})
    assert gain.share == 1 / 4
    gain.add({"q": np.zeros((0, 1)), "p": np.zeros((0, 7))})
    assert gain.share == 1 / 4
    gain.add({"q": np.full((4, 1), 0.2), "p": np.tile(here, (4, 1))})
    assert gain.share == 0.0
    gain.add({"q": np.full((1, 1), 0.2), "p": here[None] + [5, 0, 0, 0, 0, 0, 0]})
    assert gain.share == 1 / 4  # of the variable that gains most


def test_duplicate_share():
    q = np.array([[0, 0], [5e-4, -5e-4], [1, 1], [2, 2], [2, 2.0]])
    assert duplicate_share(q, 1e-3) == 0.8
    assert duplicate_share(q, 1e-4) == 0.4
    assert duplicate_share(q[:1], 1e-3) == 0.0


def test_wrong_input():
    with pytest.raises(InputError, match="cell size position is 0"):
        Cell(position=0)
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(N, dim\)"):
        cell_indices(np.zeros(3), Cell())
    with pytest.raises(InputError, match="poses have 6 columns"):
        cell_indices(np.zeros((2, 6)), Cell(), "pose")
    with pytest.raises(InputError, match="unknown kind 'angle'"):
        cell_indices(np.zeros((2, 6)), Cell(), "angle")
    with pytest.raises(InputError, match="not all finite"):
        cell_indices(np.full((2, 3), np.nan), Cell())
    with pytest.raises(InputError, match="no cell size for the variable 'b', available: a"):
        projected_coverage({"b": np.zeros((1, 2))}, {"a": Cell()})
    with pytest.raises(InputError, match="expected the reference's b"):
        fit_cells({"a": np.zeros((1, 2))}, {"b": np.zeros((1, 2))})
    with pytest.raises(InputError, match="expected 0 <= low < high <= 1"):
        fit_cells(np.zeros((1, 2)), np.zeros((1, 2)), fill=(0.6, 0.2))
    with pytest.raises(InputError, match="0 samples and 3 reference points"):
        cover_radius(np.zeros((0, 2)), np.zeros((3, 2)))
