"""Compiled programs: what belongs to their key, and what happens to one that is damaged or foreign."""

import dataclasses
import io
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from loaded import problem

import cgs_jax
from cgs_jax import cache, programs, worker
from cgs_jax.api import conditional
from cgs_jax.batches import Batch, BatchRunner, BatchSettings
from cgs_jax.errors import InputError
from cgs_jax.operators import operator_of
from cgs_jax.sampler import SamplerSettings

SETTINGS = SamplerSettings()
SMALL = BatchSettings(64, 32, SETTINGS.solver)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "_folder", tmp_path)
    monkeypatch.setattr(programs, "_compiled", {})
    return tmp_path


def grasps():
    at = problem("pick_place")
    return at, Batch(conditional(at, (), ("t",)), {}, 64, 0)


def foreign():
    """A sound executable of another function."""
    compiled = jax.jit(lambda x: x + 1.0).lower(np.zeros(3, np.float32)).compile()
    return programs.Program("foreign", compiled, 0.0).portable


def test_a_foreign_entry_of_the_cache_is_replaced(folder):
    at, batch = grasps()
    wanted = BatchRunner(at, 0, SMALL).run(batch)
    (entry,) = folder.glob("*.program")
    sound = len(entry.read_bytes())
    entry.write_bytes(foreign())
    programs._compiled.clear()
    found = BatchRunner(at, 0, SMALL).run(batch)
    np.testing.assert_array_equal(found.values["t"], wanted.values["t"])
    assert len(wanted.values["t"]) > 0 and abs(len(entry.read_bytes()) - sound) < 0.1 * sound


def test_a_damaged_entry_of_the_cache_is_replaced(folder):
    at, batch = grasps()
    wanted = BatchRunner(at, 0, SMALL).run(batch)
    (entry,) = folder.glob("*.program")
    data = entry.read_bytes()
    entry.write_bytes(data[: len(data) // 2])
    programs._compiled.clear()
    np.testing.assert_array_equal(BatchRunner(at, 0, SMALL).run(batch).values["t"], wanted.values["t"])


def test_an_entry_that_goes_before_it_is_read_is_compiled(folder):
    """Another process may have made room in the cache."""
    at, batch = grasps()
    wanted = BatchRunner(at, 0, SMALL).run(batch)
    programs._compiled.clear()
    runner = BatchRunner(at, 0, SMALL)
    (future,) = runner.request(operator_of(at, batch.transition))
    program = future.result()
    (entry,) = folder.glob("*.program")
    entry.unlink()
    assert program.portable is None
    np.testing.assert_array_equal(runner.run(batch).values["t"], wanted.values["t"])


def test_a_received_program_that_fails_is_compiled_once(folder):
    at, batch = grasps()
    runner = BatchRunner(at, 0, SMALL)
    wanted = runner.run(batch)
    received = programs.load_portable(foreign())
    other = BatchRunner(at, 0, SMALL)
    other.install(operator_of(at, batch.transition).identity, [received])
    np.testing.assert_array_equal(other.run(batch).values["t"], wanted.values["t"])
    assert other.requested()[0].result() is not received


def test_a_program_of_our_own_that_fails_ends_the_run(folder):
    at, batch = grasps()
    runner = BatchRunner(at, 0, SMALL)
    runner.run(batch)

    def fail(*arguments):
        raise RuntimeError("out of memory")

    runner.requested()[0].result()._executable = fail
    with pytest.raises(RuntimeError, match="out of memory"):
        runner.run(batch)


@pytest.mark.parametrize("name", ["XLA_FLAGS", "NPROC"])
def test_what_changes_the_generated_code_belongs_to_the_key(folder, monkeypatch, name):
    shapes = (jax.ShapeDtypeStruct((3,), np.float32),)
    monkeypatch.delenv(name, raising=False)
    before = programs._entry("any", shapes)
    monkeypatch.setenv(name, "1")
    assert programs._entry("any", shapes) != before
    monkeypatch.delenv(name)
    assert programs._entry("any", shapes) == before
    with jax.debug_nans(True):
        assert programs._entry("any", shapes) != before


def test_programs_are_kept_while_what_they_are_made_from_is_the_same():
    """The search and the files can change without a new compilation; the solver, or what it imports, cannot."""
    names = {path.stem for path in cache.imported_by("operators")}
    loaded = "import sys, cgs_jax.operators; print(*(m[8:] for m in sys.modules if m.startswith('cgs_jax.')))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    # The package itself imports its parts only when they are asked for.
    assert names == set(done.stdout.split())
    assert {"augmented_lagrangian", "seeds", "poses"} <= names and not {"uct", "sampler", "report"} & names


# ------------------------------------------------------------------ workers


def told(*messages):
    """What a worker answers to these messages."""
    sink = io.BytesIO()
    worker.serve(io.BytesIO(b"".join(map(pickle.dumps, messages))), sink)
    sink.seek(0)
    answers = []
    while sink.tell() < len(sink.getvalue()):
        answers.append(pickle.load(sink))
    return answers


def test_a_worker_with_other_sources_refuses_in_one_line():
    (answer,) = told("another digest", "messages that it must not read")
    assert isinstance(answer, InputError)
    assert "other sources" in str(answer) and "\n" not in str(answer)


def test_a_refusal_ends_the_run(monkeypatch):
    at = cgs_jax.load_problem("pick_place")
    monkeypatch.setattr(worker, "_idle", [])
    monkeypatch.setattr(cache, "SOURCES", "another digest")
    with pytest.raises(InputError, match="other sources"):
        cgs_jax.sample(at, time_budget=30.0, method="expert3")


def test_a_worker_compiles_what_it_cannot_load():
    at, batch = grasps()
    setup = worker.Setup(at.source, 0, SMALL, None, None)
    number = operator_of(at, batch.transition).identity
    answers = told(cache.SOURCES, setup, worker.Install(number, (1,), {1: b"no program"}, []), batch)
    assert answers[0] == "ready" and len(answers) == 2 and answers[1].success.all()


def test_a_worker_serves_one_run_after_another():
    at, batch = grasps()
    first, second = (worker.Setup(source, 0, SMALL, None, None) for source in (at.source, at.source._replace(instance=3)))
    answers = told(cache.SOURCES, first, batch, second, batch)
    assert answers[0] == answers[2] == "ready" and len(answers) == 4
    assert answers[1].success.all() and answers[3].success.all()


@pytest.mark.parametrize(("kept", "loaded"), [(2, [0, 3, 0]), (1, [0, 3, 0, 0])])
def test_a_worker_keeps_the_problems_that_it_ran_last(monkeypatch, kept, loaded):
    at, batch = grasps()
    seen = []
    monkeypatch.setattr(worker, "load_problem", lambda scene, i: seen.append(i) or cgs_jax.load_problem(scene, i))
    other, again = at.source._replace(instance=3), at.source._replace(number=at.source.number + 1)
    pairs = (at.source, 0), (other, 0), (at.source, 1), (again, 0)
    setups = [worker.Setup(*pair, SMALL, None, None, kept) for pair in pairs]
    answers = told(cache.SOURCES, *(message for setup in setups for message in (setup, batch)))
    assert seen == loaded
    first, _, second, third = (answer.values["t"] for answer in answers[1::2])
    # Another seed is drawn from on what is kept; a file that was loaded again is read again.
    assert not np.array_equal(first, second) and np.array_equal(first, third)


@pytest.mark.parametrize(("kept", "times"), [(2, 1), (1, 2)])
def test_what_a_worker_has_forgotten_is_sent_again(monkeypatch, kept, times):
    sent = []
    monkeypatch.setattr(worker.Worker, "_send", lambda self, message: sent.append(message))
    at, _ = grasps()
    one = worker.Worker()
    for source, seed in ((at.source, 0), (at.source, 1), (at.source._replace(instance=3), 0), (at.source, 2)):
        one.begin(worker.Setup(source, seed, SMALL, None, None, kept))
        if source == at.source:
            one.install(7, [], [])
    one.close()
    assert sum(isinstance(message, worker.Install) for message in sent) == times


def test_the_next_run_takes_the_workers_of_the_last(monkeypatch):
    monkeypatch.setattr(worker, "_idle", [])
    at = cgs_jax.load_problem("pick_place")
    seen = []
    for seed in range(2):
        cgs_jax.sample(at, time_budget=60.0, num_samples=40_000, seed=seed, method="expert3")
        seen.append({one._process.pid for one in worker._idle})
        assert all(one.usable for one in worker._idle)
    assert seen[0] and seen[0] <= seen[1]
    for one in worker._idle:
        one.close()


def test_a_worker_that_several_threads_ask_gives_each_its_answer(monkeypatch):
    monkeypatch.setattr(worker, "_idle", [])
    at, batch = grasps()
    one = worker.hire(worker.Setup(at.source, 0, SMALL, None, None))
    assert one.await_ready()
    with ThreadPoolExecutor(4) as threads:
        questions = [dataclasses.replace(batch, tasks=count) for count in range(1, SMALL.batch_size + 1)]
        answers = list(threads.map(one.run, questions))
    one.close()
    assert [len(answer.success) for answer in answers] == [question.tasks for question in questions]


def test_a_worker_that_failed_is_not_kept(monkeypatch):
    monkeypatch.setattr(worker, "_idle", [])
    at, batch = grasps()
    one = worker.hire(worker.Setup(at.source, 0, SMALL, None, None))
    assert one.await_ready()
    with pytest.raises(Exception, match="object"):
        one.run("no batch")
    worker.dismiss(one)
    assert worker._idle == [] and one._process.poll() is not None
