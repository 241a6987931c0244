"""Algorithm 1 over pick_place: what the events say adds up, runs repeat, failures cost what they should."""

import itertools

import numpy as np
import pytest
from loaded import problem

from cgs_jax.api import make_chooser
from cgs_jax.errors import InputError
from cgs_jax.operators import operator_of
from cgs_jax.sampler import Finished, Found, Pool, Ran, Sampler, SamplerSettings, Started, _Pace

SETTINGS = SamplerSettings(batch_size=128, lanes=32, workers=1, deterministic=True)


def sampler(method="expert2", seed=0, **changes):
    at = problem("pick_place")
    settings = SamplerSettings(**(vars(SETTINGS) | changes))
    return Sampler(at, make_chooser(at, method, seed, pools=settings.pools), seed, settings)


def run(method="expert2", budget=20.0, number=60, **changes):
    return list(sampler(method, **changes).events(budget, number))


def of(kind, events):
    return [event for event in events if isinstance(event, kind)]


@pytest.fixture(scope="module")
def fixed():
    return run()


def test_a_fixed_sequence_is_the_only_one_that_runs(fixed):
    paths = {" ".join(map(str, event.path)) for event in of(Ran, fixed)}
    assert len(paths) == 1
    texts = {event.sequence for event in of(Found, fixed)}
    assert texts == {problem("pick_place").transitions.format(of(Ran, fixed)[0].path)}
    assert {event.position for event in of(Ran, fixed)} == {0, 1, 2}


def test_events_come_in_order_and_end_with_the_number_asked_for(fixed):
    assert sum(len(event.qpos) for event in of(Found, fixed)) == 60
    assert len(of(Started, fixed)) == 1 and isinstance(fixed[-1], Finished) and fixed[-1].reason == "samples"
    times = [event.elapsed for event in of(Found, fixed)]
    assert times == sorted(times)
    for event in of(Found, fixed):
        assert {name: len(value) for name, value in event.values.items()} == dict.fromkeys(("t", "q1", "q2"), len(event.qpos))
        assert event.qpos.shape[1:] == (2, problem("pick_place").scene.model.nq)


def test_samples_are_handed_over_when_as_many_wait_as_were_found():
    waiting = found = handed_over = 0
    for event in sampler().events(60.0, 2000):
        if isinstance(event, Ran):
            assert waiting == 0 or waiting < found
            waiting += event.cleared * (event.position == len(event.path) - 1)
        elif isinstance(event, Found):
            found, waiting, handed_over = found + len(event.qpos), 0, handed_over + 1
    assert found == 2000 and handed_over > 4


def test_what_is_charged_is_what_the_quicker_batches_took():
    """2,048 tasks of seven iterations in 0.5 s at first, in 0.02 s once the machine has settled."""
    at = problem("pick_place")
    operator = operator_of(at, at.transitions.parse("t; q1; q2")[1])
    pace, tasks = _Pace(128, 2048), 2048
    charged = [pace.seconds(operator, tasks, 7 * tasks, measured, look=False) for measured in (0.5, 0.5, 0.02, 0.02)]
    assert min(charged[:2]) >= 0.5
    assert charged[2:] == pytest.approx([0.02, 0.02])
    assert pace.seconds(operator, tasks, 7 * tasks, 0.5, look=False) == pytest.approx(0.02)


def test_batches_of_a_fixed_sequence_are_full_from_the_third_one_on(fixed):
    """Three and six eighths at first: until something has come through all steps there is no sample."""
    sizes = [event.tasks for event in of(Ran, fixed) if event.position == 0]
    assert sizes[:3] == [3 * SETTINGS.batch_size // 8, 6 * SETTINGS.batch_size // 8, SETTINGS.batch_size]
    assert set(sizes[2:]) == {SETTINGS.batch_size}


def test_the_tree_pursues_its_first_sequence_to_the_end_and_explores_in_small_batches():
    begun = sampler("tree", batch_size=512)
    tree, known = begun.chooser, ()
    before_the_end, explored = set(), []
    ended = False
    for event in begun.events(60.0, 2000):
        if not isinstance(event, Ran):
            continue
        ended |= event.position == len(event.path) - 1
        if not ended:
            before_the_end.add(event.path)
        # Another one may have become the incumbent since the last event.
        if known and event.path not in (known, tree.incumbent):
            explored.append(event.tasks)
        known = tree.incumbent
    assert len(before_the_end) == 1
    assert explored and max(explored) <= 512 // 4


@pytest.mark.parametrize("hopeless", [False, True])
def test_a_look_goes_on_to_the_next_step_unless_there_is_no_hope(hopeless, monkeypatch):
    begun = sampler("tree")
    sequences = problem("pick_place").transitions.parse("t; q2; q1"), problem("pick_place").transitions.parse("t; q1; q2")
    monkeypatch.setattr(begun.chooser, "select", lambda ready: sequences[0])
    monkeypatch.setattr(begun.chooser, "hopeless", lambda path: hopeless and path == sequences[1])
    begun._pursued, begun._patience, begun._ended = sequences[1], 4, True
    assert begun._choose() == sequences[not hopeless]


@pytest.mark.parametrize(("waiting", "looked_at"), [(15, "t"), (16, "q1")])
def test_a_first_look_takes_few_conditions(waiting, looked_at):
    begun = sampler("t; q1; q2", batch_size=2048)
    path = begun.chooser.path
    grasps, *_ = begun._steps_of(path)
    begun._pool(grasps.makes).put({"t": np.zeros((waiting, 7), np.float32)})
    assert begun._job_of(path).step.transition.new == (looked_at,)


def test_what_runs_may_need_is_made_before_them():
    at = problem("pick_place")
    begun = sampler("tree")
    list(begun.prepare())
    first = {transition.problem: transition for transition in at.transitions.all()}
    for transition in first.values():
        operator = operator_of(at, transition)
        assert begun._runner.ready(operator) and begun._runner.is_aimed(operator)
        assert all(future.result()._executable is not None for future in begun._runner.request(operator))


def test_numbers_of_a_batch_add_up(fixed):
    for event in of(Ran, fixed):
        assert event.tasks >= event.proposed >= event.cleared >= 0
        assert sum(event.failures.values()) == event.tasks - event.cleared
        assert set(event.failures) <= set(event.path[event.position].constraints)
        assert event.first_successes <= event.first_tries and event.second_successes <= event.second_tries
        assert event.first_tries + event.second_tries <= event.tasks


def test_no_step_uses_more_conditions_than_the_steps_before_made(fixed):
    made, fresh = dict.fromkeys(range(3), 0), dict.fromkeys(range(3), 0)
    for event in of(Ran, fixed):
        made[event.position] += event.cleared
        fresh[event.position] += event.first_tries
        if event.position:
            assert fresh[event.position] <= made[event.position - 1]


def test_no_two_samples_share_a_value(fixed):
    for name in ("t", "q1", "q2"):
        values = np.concatenate([event.values[name] for event in of(Found, fixed)])
        assert len(np.unique(values, axis=0)) == len(values)


def test_the_same_seed_repeats_the_run_and_another_does_not(fixed):
    again, other = run(), run(seed=1)
    first, second, third = (np.concatenate([e.values["q2"] for e in of(Found, events)]) for events in (fixed, again, other))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first[:5] - third[:5]).max() > 1e-3


def test_the_streams_do_not_depend_on_the_batch_size():
    small, large = (of(Found, run(tries=1, batch_size=size)) for size in (128, 64))
    for name in ("t", "q1", "q2"):
        first, second = (np.concatenate([event.values[name] for event in events]) for events in (small, large))
        np.testing.assert_allclose(first, second, atol=1e-6)


def test_a_condition_is_tried_as_often_as_the_settings_say():
    once = of(Ran, run(tries=1))
    assert sum(event.second_tries for event in once) == 0
    assert all(event.first_tries == event.tasks for event in once)
    assert sum(event.second_tries for event in of(Ran, run())) > 0


def test_without_pools_the_same_samples_are_valid():
    events = run(pools=False, number=20)
    assert sum(len(event.qpos) for event in of(Found, events)) == 20


def test_samples_are_neither_piled_on_limits_nor_on_each_other():
    low, high = problem("pick_place").params.limits["q1"]
    found = run(number=600)
    for name in ("q1", "q2"):
        q = np.concatenate([event.values[name] for event in of(Found, found)])
        at_limit = (np.minimum(q - low, high - q) < 1e-3 * (high - low)).any(axis=1)
        assert at_limit.mean() < 0.05
        near = [np.abs(a - b).max() < 1e-2 for a, b in itertools.combinations(q, 2)]
        assert np.mean(near) < 0.01


def test_clearances_may_be_kept_inside_the_solver():
    events = run("expert3", collisions="inside", number=30)
    assert sum(len(event.qpos) for event in of(Found, events)) == 30
    assert sum(event.rejected for event in of(Found, events)) == 0
    # Nothing is checked afterwards; a collision is one of the causes for which a projection fails.
    assert all(event.proposed == event.cleared for event in of(Ran, events))
    assert any(name.startswith("Collision") for event in of(Ran, events) for name in event.failures)
    first = [event for event in of(Ran, events) if event.position == 0]
    # Checked afterwards, a third of these seeds succeeds.
    assert sum(event.cleared for event in first) > 0.45 * sum(event.tasks for event in first)
    with pytest.raises(InputError, match="expected one of: after, inside"):
        sampler(collisions="never")


def test_stop_ends_the_run_after_the_batches_in_flight():
    at_work = sampler()
    events = []
    for event in at_work.events(60.0):
        events.append(event)
        if isinstance(event, Found):
            at_work.stop()
    assert events[-1].reason == "interrupt"
    assert len(of(Found, events)) >= 1


def test_a_run_that_is_stopped_makes_no_more_samples_than_were_wanted():
    at_work = sampler()
    events = []
    for event in at_work.events(60.0, 3):
        events.append(event)
        # Full samples wait for their audit at this moment.
        if isinstance(event, Ran) and event.position == len(event.path) - 1 and event.cleared > 3:
            at_work.stop()
    assert events[-1].reason == "interrupt"
    assert sum(len(event.qpos) for event in of(Found, events)) == 3


def test_the_budget_ends_the_run():
    events = run(budget=0.3, number=None, deterministic=False)
    assert events[-1].reason == "time" and 0.3 <= events[-1].elapsed < 3.0


def test_independent_components_survive_a_failure():
    # q1 and q2 depend on each other through t alone; t waits in its pool until both steps have drawn from it.
    events = of(Ran, run("t; q1; q2"))
    cleared = {k: sum(e.cleared for e in events if e.position == k) for k in range(3)}
    assert cleared[0] >= cleared[1] >= cleared[2] > 0


def test_a_pool_gives_back_in_order_what_was_put_in():
    pool = Pool()
    for part in (np.arange(3), np.arange(3, 8), np.empty(0)):
        pool.put({"x": part})
    assert pool.size == 8
    np.testing.assert_array_equal(pool.take(5)["x"], np.arange(5))
    np.testing.assert_array_equal(pool.take(3)["x"], np.arange(5, 8))
    assert pool.size == 0
