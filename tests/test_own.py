"""A user's own variables and samplers: supports on paper, derivatives, graphs, and one-line refusals."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loaded import matrices, problem
from scipy import stats

import cgs_jax
from cgs_jax import seeds
from cgs_jax.api import conditional
from cgs_jax.audit import Auditor, Tolerances
from cgs_jax.errors import InputError
from cgs_jax.operators import gather_given, operator_of
from cgs_jax.own import own_checks
from cgs_jax.plans import PlanSystem
from cgs_jax.poses import from_vector
from cgs_jax.sampler import SamplerSettings

SMALL = SamplerSettings(batch_size=128, lanes=32)
LANES = 512
HALF = 0.5**0.5


def from_above(key):
    """A valid grasp of pick_place's box: the fingers' axis along its x, pointing down, up to 5 cm above its middle."""
    return jnp.array([0.0, 0.0, 0.05 * jax.random.uniform(key) ** 0.5, 0.0, HALF, HALF, 0.0])


def with_force(low=5.0, high=60.0, dof=1):
    return cgs_jax.with_variable(problem("pick_place"), "force", dof, low, high)


def seeds_of(at, given, new, read=None, lanes=LANES):
    """What the solver starts from: the point and the names of its configurations and free poses."""
    operator = operator_of(at, conditional(at, given, new))
    layout, numbers = operator.plan.layout, jax.tree.map(jnp.asarray, operator.numbers(at.params))
    read = {name: np.asarray(value, np.float32) for name, value in (read or {}).items()}
    vectors = jnp.transpose(jnp.asarray(gather_given(operator, at.params, read, lanes)), (2, 1, 0))
    pose = jax.tree.map(lambda a: jnp.moveaxis(a, -2, 0), from_vector(vectors))
    q = tuple(jnp.asarray(read[name]).T for name in operator.plan.given_configurations)
    tasks, key = jnp.arange(lanes, dtype=jnp.uint32), jax.random.key(3)

    @jax.jit
    def run():
        u, own = seeds.uniforms(key, tasks, seeds.count_draws(layout)), seeds.draw_own(layout, key, tasks, vectors, q)
        return seeds.draw(layout, pose, q, numbers.tables, numbers.seeds, numbers.choices, numbers.shared, u, own)

    point, data = run()
    return operator, numbers, point, data


# ------------------------------------------------------------------ variables


def test_seeds_of_a_vector_are_uniform_within_its_limits():
    at = with_force([5.0, -1.0], [60.0, 1e-3], dof=2)
    operator, _, point, _ = seeds_of(at, (), ("force",))
    for values, low, high in zip(np.asarray(point.configurations)[0, :2], (5.0, -1.0), (60.0, 1e-3), strict=True):
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 0.001
    assert operator.plan.layout.vectors == (0,)


def test_jacobians_by_vectors_and_drawn_poses_agree_with_finite_differences():
    at = with_force(-3.0, [4.0, 50.0], dof=2)
    at = cgs_jax.with_sampler(at, "t", from_above)

    def mixed(force, t):
        return jnp.stack([force[0] * force[1] * t[2], jnp.sin(force[0]) + t[4] * t[0]])

    at = cgs_jax.with_constraint(at, "mixed", ("force", "t"), mixed, "inequality", 2)
    operator, numbers, point, data = seeds_of(at, (), ("t", "force"), lanes=2)
    with jax.enable_x64(True):
        point, data = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (point, data))
        system, n, h = PlanSystem(operator.plan.layout), operator.plan.layout.unknowns, 1e-6
        rows = jax.jit(lambda x: system.rows(x, (data, numbers.shared)))
        # Turned a little, for the box axes to have no derivative that vanishes.
        point = system.retract(point, jnp.full((n, 2), 0.3))
        for i in range(n):
            step = jnp.zeros((n, 2)).at[i].set(h)
            numeric = (rows(system.retract(point, step)).value - rows(system.retract(point, -step)).value) / (2 * h)
            np.testing.assert_allclose(rows(point).jacobian[:, i], numeric, atol=1e-5)


@pytest.fixture(scope="module")
def tied():
    """pick_place with a force that depends on the arm at the place, and a gap that nothing ties."""
    at = cgs_jax.with_variable(with_force(), "gap", 2, 0.01, 0.02)
    return cgs_jax.with_constraint(
        at, "pull", ("force", "q2"), lambda force, q2: (force - 30.0 - 8.0 * q2[:1]) / 10.0, "equality", 1
    )


@pytest.fixture(scope="module")
def samples(tied):
    return cgs_jax.sample(tied, 30.0, 40, method="t; q1; q2; force; gap", settings=SMALL)


def test_samples_satisfy_an_equality_between_a_vector_and_a_configuration(samples):
    assert len(samples) == 40 and samples["force"].shape == (40, 1)
    force, first_joint = samples["force"][:, 0].astype(float), samples["q2"][:, 0].astype(float)
    assert np.abs(force - 30.0 - 8.0 * first_joint).max() / 10.0 < 1e-4
    assert force.min() >= 5.0 and force.max() <= 60.0 and np.ptp(force) > 1.0
    assert (samples["gap"] >= 0.01 - 1e-6).all() and (samples["gap"] <= 0.02 + 1e-6).all()


def test_columns_of_the_file_name_a_users_parts(samples, tmp_path):
    back = cgs_jax.SampleSet.load(samples.save(tmp_path))
    assert back.constraints[-3:] == ("own: pull", "own: limits of force", "own: limits of gap")
    assert back.violation[:, -3:].max() <= 1e-4
    assert back.kinds["force"] == "vector"
    np.testing.assert_array_equal(back["gap"], samples["gap"])


def test_the_audit_evaluates_a_users_constraint_in_double_precision(tied):
    pull, limits, _ = own_checks(tied)
    q2 = np.zeros((300, 7))
    force = np.full((300, 1), 30.0)
    force[17], force[270] = 30.0 + 1e-9, np.nan
    violation = pull.violation({"force": force, "q2": q2})
    np.testing.assert_allclose(violation[17], 1e-10, rtol=1e-3)
    assert violation[270] == np.inf and np.delete(violation, [17, 270]).max() == 0.0
    np.testing.assert_allclose(limits.violation({"force": np.array([[4.0], [30.0], [66.0]])}), [1 / 60, 0.0, 0.1])


def test_the_audit_rejects_what_breaks_a_users_constraint(tied, samples):
    auditor = Auditor(tied.scene.model, [], [], [], samples.mode_switches, Tolerances(own=1e-4), own_checks(tied))
    values = {name: samples[name].copy() for name in samples.variables}
    values["force"][3] += 0.01
    values["gap"][5, 1] = 0.03
    result = auditor.check(samples.qpos, values)
    assert np.flatnonzero(~result.ok).tolist() == [3, 5]
    np.testing.assert_allclose(result.violation[3, result.constraints.index("own: pull")], 1e-3, rtol=0.1)
    with pytest.raises(InputError, match="no values of 'force', which a condition reads"):
        auditor.check(samples.qpos, {"q2": samples["q2"]})


# ------------------------------------------------------------------ samplers


@pytest.fixture(scope="module")
def together():
    """An operator of three: t from its sampler, force from one that is outside the limits half of the time, and a vector in the
    thousands that the solver has to bring onto a circle."""
    at = cgs_jax.with_sampler(problem("pick_place"), "t", from_above)
    at = cgs_jax.with_variable(at, "force", 1, 0.0, 1.0)
    at = cgs_jax.with_sampler(at, "force", lambda key: 2.0 * jax.random.uniform(key, (1,)))
    at = cgs_jax.with_variable(at, "load", 2, -2000.0, 2000.0)
    at = cgs_jax.with_constraint(
        at, "circle", ("load",), lambda load: jnp.sum(load**2, keepdims=True) / 1e6 - 1.0, "equality", 1
    )
    apply = cgs_jax.operator(at, (), ("t", "force", "load"))
    values, feasible = jax.jit(lambda key: apply(key, {}, at.params, 2048))(jax.random.key(0))
    return {name: np.asarray(value, float)[np.asarray(feasible)] for name, value in values.items()}, float(feasible.mean())


def test_what_satisfies_its_constraints_leaves_an_operator_as_it_was_drawn(together):
    values, _ = together
    assert np.abs(values["t"][:, :2]).max() == 0.0
    rotation = matrices(values["t"])[:, :3, :3]
    np.testing.assert_allclose(rotation, np.tile([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]], (len(rotation), 1, 1)), atol=1e-6)
    # The height's distribution on paper: P(height < h) = (h / 0.05)^2.
    assert stats.kstest(values["t"][:, 2], lambda h: np.clip(h / 0.05, 0, 1) ** 2).pvalue > 0.001


def test_values_outside_the_limits_fail_and_are_not_clipped(together):
    values, share = together
    assert 0.45 < share < 0.55
    assert stats.kstest(values["force"][:, 0], "uniform").pvalue > 0.001


def test_a_vector_is_solved_for_in_units_of_its_range(together):
    values, _ = together
    np.testing.assert_allclose(np.linalg.norm(values["load"], axis=1), 1000.0, atol=0.02)
    assert np.ptp(np.arctan2(*values["load"].T)) > 6.0


def test_a_sampler_reads_what_is_assigned_and_what_was_drawn_before_it():
    at = cgs_jax.with_sampler(with_force(0.0, 1.0), "force", lambda key, t: 10.0 * t[2:3], ("t",))
    assert "Sampler(force|t)" in [c.name for c in at.graph.constraints]
    assert conditional(at, ("t",), ("force",)).condition == {"t"}
    heights = np.linspace(0.0, 0.09, LANES)
    poses = np.concatenate([np.zeros((LANES, 2)), heights[:, None], np.tile([0, HALF, HALF, 0], (LANES, 1))], axis=1)
    _, _, point, _ = seeds_of(at, ("t",), ("force",), {"t": poses})
    np.testing.assert_allclose(np.asarray(point.configurations)[0, 0], 10.0 * heights, atol=1e-6)
    # Without a sampler of t the two together start anywhere; with one, force follows t.
    _, _, point, _ = seeds_of(at, (), ("t", "force"))
    assert np.ptp(np.asarray(point.configurations)[0, 0]) > 0.9
    at = cgs_jax.with_sampler(at, "t", from_above)
    _, _, point, _ = seeds_of(at, (), ("t", "force"))
    np.testing.assert_allclose(point.configurations[0, 0], 10.0 * np.asarray(point.free.position)[0, 2], atol=1e-6)


def test_a_failed_draw_is_named_in_the_diagnosis():
    """Of a sampler whose variable no row reads, and of one that a row reads too."""
    at = cgs_jax.with_sampler(with_force(0.0, 1.0), "force", lambda key, t: jnp.full((1,), jnp.nan), ("t",))
    read = cgs_jax.with_constraint(at, "pull", ("force",), lambda force: force - 0.5, "inequality", 1)
    for problem_at in (at, read):
        run = cgs_jax.Run(problem_at, "t; force; q1; q2", settings=SMALL)
        for event in run.events(60.0):
            if type(event).__name__ == "Ran" and event.path[event.position].new == ("force",):
                assert event.failures == {"Sampler(force|t)": event.tasks}
                run.stop()
        assert "operator force | t succeeded 0 of" in run.record.diagnosis()
        assert "Sampler(force|t) stopped 100 % of its failures" in run.record.diagnosis()
    at = cgs_jax.with_sampler(with_force(0.0, 1.0), "force", lambda key: 2.0 * jax.random.uniform(key, (1,)))
    run = cgs_jax.Run(at, "force; t; q1; q2", settings=SMALL)
    for event in run.events(60.0):
        if type(event).__name__ == "Ran" and event.path[event.position].new == ("force",):
            assert event.failures == {"Sampler(force)": event.tasks - event.cleared}
            assert 0.3 < event.cleared / event.tasks < 0.7
            run.stop()


def test_samplers_of_configurations_are_the_seeds_that_others_are_judged_by(monkeypatch):
    monkeypatch.setattr(seeds, "JITTER", 0.0)
    monkeypatch.setattr(seeds, "ANYWHERE", 0.0)
    low, high = map(jnp.asarray, problem("pick_place").params.limits["q2"])
    half = 0.5 * (low + high)
    at = cgs_jax.with_sampler(problem("pick_place"), "q2", lambda key: jax.random.uniform(key, (7,), minval=low, maxval=half))
    operator, numbers, point, data = seeds_of(at, (), ("q1", "q2", "t"))
    assert operator.plan.configurations == ("q2", "q1")
    for joint, values in enumerate(np.asarray(point.configurations[0])):
        assert stats.kstest(values, stats.uniform(low[joint], (half - low)[joint]).cdf).pvalue > 0.001
    rows = jax.jit(lambda q: PlanSystem(operator.plan.layout).rows(point._replace(configurations=q), (data, numbers.shared)))

    def residual(q):
        """Of the loop that is left: the grasp that q2 defines, closed by q1 at the pick."""
        value = np.asarray(rows(q).value).reshape(operator.plan.layout.words, 6, LANES)
        return float(np.median(np.linalg.norm(value[operator.plan.rows.index("Kin(q1,t)")], axis=0)))

    other = point.configurations.at[1].set(jnp.roll(point.configurations[1], 1, axis=-1))
    assert residual(point.configurations) < 0.7 * residual(other)


def test_a_grasp_that_touches_is_held_to_the_site_it_touches():
    at = problem("banana")
    sites = np.asarray(at.params.sites["Grasp(t_b)"], float)
    flipped = matrices(sites) @ np.diag([1.0, -1.0, -1.0, 1.0])
    grasps = np.linalg.inv(flipped)
    vectors = np.zeros((len(sites), 7))
    for i, grasp in enumerate(grasps):
        vectors[i, :3] = grasp[:3, 3]
        mujoco.mju_mat2Quat(vectors[i, 3:], grasp[:3, :3].ravel())
    table = jnp.asarray(vectors, jnp.float32)
    at = cgs_jax.with_sampler(at, "t_b", lambda key: table[jax.random.randint(key, (), 0, len(table))])
    operator, numbers, point, data = seeds_of(at, (), ("t_b",))
    rows = jax.jit(PlanSystem(operator.plan.layout).rows)(point, (data, numbers.shared))
    assert np.abs(np.asarray(rows.value)[:5]).max() < 1e-5
    places = np.asarray(point.free.position)[0].T
    assert {tuple(np.abs(vectors[:, :3] - place).max(axis=1) < 1e-6) for place in places} == {
        tuple(np.abs(vectors[:, :3] - place).max(axis=1) < 1e-6) for place in vectors[:, :3]
    }


# ------------------------------------------------------------------ refusals

VARIABLES = {
    "taken": (dict(name="q1"), "variable 'q1' exists already, expected a name other than: q1"),
    "no name": (dict(name="a b"), "'a b' is not usable, expected a Python name"),
    "dof": (dict(dof=0), "dof 0, expected a whole number of at least 1"),
    "infinite": (dict(high=np.inf), "high = inf, expected finite numbers"),
    "count": (dict(low=[0.0, 0.0, 0.0]), "expected one number or 2"),
    "order": (dict(low=1.0), "expected low < high"),
    "text": (dict(low="none"), "expected one number or 2"),
}


@pytest.mark.parametrize("case", VARIABLES)
def test_wrong_variables_are_refused_in_one_line(case):
    change, message = VARIABLES[case]
    with pytest.raises(InputError, match=message) as caught:
        cgs_jax.with_variable(problem("pick_place"), **(dict(name="mine", dof=2, low=0.0, high=1.0) | change))
    assert "\n" not in str(caught.value)


def numpy_only(key):
    return np.asarray(key).sum()


SAMPLERS = {
    "unknown": (("x",), from_above, (), "unknown variable 'x'; available: q1"),
    "nothing": ((), from_above, (), "sampler of no variables, expected some of"),
    "twice": (("t",), from_above, ("t",), "names a variable twice"),
    "given": ("t", from_above, ("q1",), "failed with TypeError.*expected a JAX function of a key, the keyword q1"),
    "shape": ("t", lambda key: jnp.zeros(6), (), r"returns shapes \(6,\), expected \(7,\) for t"),
    "tuple": (("t", "q1"), from_above, (), r"returns a \w+, expected a tuple of \(7,\) for t, \(7,\) for q1"),
    "not finite": ("t", lambda key: from_above(key) * jnp.inf, (), "not finite in 64 of 64 draws"),
    "length": ("t", lambda key: 2.0 * from_above(key), (), "quaternions that are not unit"),
    "limits": ("q1", lambda key: jnp.full(7, 9.0), (), "no 'q1' within its limits in 64 draws"),
    "not jax": ("t", numpy_only, (), "failed with .*expected a JAX function of a key"),
}


@pytest.mark.parametrize("case", SAMPLERS)
def test_wrong_samplers_are_refused_in_one_line(case):
    variables, function, given, message = SAMPLERS[case]
    with pytest.raises(InputError, match=message) as caught:
        cgs_jax.with_sampler(problem("pick_place"), variables, function, given)
    assert "\n" not in str(caught.value)


def test_a_variable_has_one_sampler():
    at = cgs_jax.with_sampler(problem("pick_place"), "t", from_above)
    with pytest.raises(InputError, match="'t' has a sampler already"):
        cgs_jax.with_sampler(at, "t", from_above)
    assert problem("pick_place").samplers == () and at.source is None


def test_a_constraint_that_insists_on_single_precision_is_refused():
    def insists(q1):
        return jax.lax.add(q1[:1], jnp.ones(1, jnp.float32))

    with pytest.raises(InputError, match="failed in double precision with TypeError.*no fixed float32 types") as caught:
        cgs_jax.with_constraint(problem("pick_place"), "mine", ("q1",), insists, "inequality", 1)
    assert "\n" not in str(caught.value)
