import os
import stat

import gantry
import numpy as np
import pytest

from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet, kind_of


def some(count=6, seed=0):
    qpos, t, _ = gantry.valid(count, seed)
    return gantry.sample_set(qpos, t)


def test_file_has_the_schema_and_comes_back(tmp_path):
    samples = some()
    path = samples.save(tmp_path / "deep" / "run")
    assert path == tmp_path / "deep" / "run" / "samples.npz"
    assert os.listdir(path.parent) == ["samples.npz"]
    with np.load(path, allow_pickle=False) as archive:
        assert str(archive["schema"]) == "cgs_jax/1"
        assert archive["variables"].tolist() == ["q_1", "q_2", "t"]
        assert archive["qpos"].shape == (6, 2, 12) and archive["qpos"].dtype == np.float64
        assert archive["x_t"].shape == (6, 7)
        assert all(archive[key].shape == () for key in ("schema", "mjcf", "attachments", "placements", "goals", "meta"))
    back = SampleSet.load(path.parent)
    lists = ("attachments", "placements", "goals", "configurations")
    for name in ("mjcf", "mode_switches", *lists, "sequences", "constraints", "meta", "kinds"):
        assert getattr(back, name) == getattr(samples, name), name
    for name in ("qpos", "sequence", "elapsed", "violation"):
        np.testing.assert_array_equal(getattr(back, name), getattr(samples, name))
    np.testing.assert_array_equal(back["q_2"], samples["q_2"])
    assert len(back) == 6


def test_file_may_be_named_and_holds_numpy_numbers_in_meta(tmp_path):
    samples = some()
    path = gantry.sample_set(samples.qpos, samples["t"]).save(tmp_path / "my.npz")
    assert path.name == "my.npz"
    mixed = SampleSet(mjcf="", variables={}, mode_switches=("a",), qpos=np.zeros((0, 1, 3)), meta={"n": np.int64(3)})
    assert SampleSet.load(mixed.save(tmp_path)).meta == {"n": 3}


def test_empty_set_comes_back(tmp_path):
    empty = some().select([])
    back = SampleSet.load(empty.save(tmp_path))
    assert len(back) == 0 and back["t"].shape == (0, 7) and back.best_sequence is None
    assert back.kinds["t"] == "pose"
    assert back.diverse(3).tolist() == []


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    samples = some()
    path = samples.save(tmp_path)
    before = path.read_bytes()

    def full_disk(file, **arrays):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(InputError, match="cannot write .*samples.npz: No space left on device"):
        samples.save(tmp_path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["samples.npz"]


def test_file_has_ordinary_permissions(tmp_path):
    umask = os.umask(0o022)
    try:
        path = some().save(tmp_path)
    finally:
        os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_unwritable_place(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        some().save(tmp_path / "file" / "samples.npz")


def test_load_names_what_is_wrong(tmp_path):
    with pytest.raises(InputError, match="no sample file .*nowhere.npz"):
        SampleSet.load(tmp_path / "nowhere.npz")
    with pytest.raises(InputError, match="no sample file .*samples.npz"):
        SampleSet.load(tmp_path)
    path = some().save(tmp_path)
    whole = path.read_bytes()
    cases = {
        "cannot read": whole[: len(whole) // 2],
        "cannot read .*: it is no archive, expected an .npz": b"not an archive",
        "cannot read .*expected an .npz": b"",
    }
    for message, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=message) as caught:
            SampleSet.load(path)
        assert "\n" not in str(caught.value)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(InputError, match="expected an .npz"):
        SampleSet.load(tmp_path / "array.npy")
    np.savez(tmp_path / "pickled.npz", schema=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="cannot read"):
        SampleSet.load(tmp_path / "pickled.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": np.array("cgs_jax/2")}, "has schema cgs_jax/2, expected cgs_jax/1"),
        ({"schema": None}, "has schema none"),
        ({"x_t": None}, "lacks x_t"),
        ({"meta": None, "goals": None}, "lacks goals, meta"),
        ({"meta": np.array("{")}, "is damaged"),
        ({"qpos": np.zeros((6, 3, 12))}, r"qpos has shape \(6, 3, 12\), expected \(N, 2, nq\)"),
        ({"x_t": np.zeros((5, 7))}, r"variable 't' has shape \(5, 7\), expected \(6, dim\)"),
        ({"sequence": np.full(6, 2)}, "index outside the 2 sequences"),
    ],
)
def test_load_refuses_a_foreign_or_wrong_archive(tmp_path, change, message):
    with np.load(some().save(tmp_path), allow_pickle=False) as archive:
        stored = {**archive, **change}
    np.savez(tmp_path / "changed.npz", **{key: value for key, value in stored.items() if value is not None})
    with pytest.raises(InputError, match=message):
        SampleSet.load(tmp_path / "changed.npz")


def test_unknown_variable():
    with pytest.raises(InputError, match="unknown variable 'q_3', available: q_1, q_2, t"):
        some()["q_3"]


def test_select_by_positions_mask_and_slice():
    samples = some()
    picked = samples.select([4, 1])
    np.testing.assert_array_equal(picked.qpos, samples.qpos[[4, 1]])
    np.testing.assert_array_equal(picked["t"], samples["t"][[4, 1]])
    np.testing.assert_array_equal(picked.elapsed, samples.elapsed[[4, 1]])
    assert len(samples.select(samples.elapsed > 0.5)) == 3
    assert len(samples.select(slice(2))) == 2
    assert len(samples.select(3)) == 1


def test_best_sequence_made_most():
    samples = some().select([1, 3, 5, 0])
    assert samples.best_sequence == "(q_1, q_2, t)"


def test_concatenate_joins_the_sequences():
    first, second = some(4), some(3, seed=1)
    turned = gantry.sample_set(second.qpos, second["t"])
    object.__setattr__(turned, "sequences", ("q_2; t; q_1", "t; q_1; q_2"))
    joined = SampleSet.concatenate([first, turned])
    assert len(joined) == 7
    assert joined.sequences == ("t; q_1; q_2", "(q_1, q_2, t)", "q_2; t; q_1")
    assert [joined.sequences[i] for i in joined.sequence[4:]] == ["q_2; t; q_1", "t; q_1; q_2", "q_2; t; q_1"]
    np.testing.assert_array_equal(joined["q_1"][4:], second["q_1"])
    foreign = SampleSet(**{**vars(second), "mjcf": "<mujoco/>"})
    with pytest.raises(InputError, match="differ in mjcf"):
        SampleSet.concatenate([first, foreign])
    with pytest.raises(InputError, match="no sample set"):
        SampleSet.concatenate([])


def plain(variables, kinds):
    count = len(next(iter(variables.values())))
    return SampleSet(
        mjcf="",
        variables=variables,
        kinds=kinds,
        mode_switches=("a",),
        qpos=np.zeros((count, 1, 1)),
        sequences=("s",),
        sequence=np.zeros(count, int),
        elapsed=np.zeros(count),
        violation=np.zeros((count, 0)),
    )


def test_diverse_takes_the_farthest_point_each_time():
    """Against the definition, with the whole matrix of distances of the stated metric."""
    rng = np.random.default_rng(0)
    q, pose = rng.normal(size=(60, 3)), np.concatenate([rng.normal(size=(60, 3)), rng.normal(size=(60, 4))], axis=1)
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    chosen = plain({"q": q, "p": pose}, {"q": "configuration", "p": "pose"}).diverse(12)

    def spread(x):
        return np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean())

    angle = 2 * np.arccos(np.minimum(np.abs(pose[:, 3:] @ pose[:, 3:].T), 1))
    mean = np.linalg.eigh(pose[:, 3:].T @ pose[:, 3:])[1][:, -1]
    about_mean = np.sqrt(((2 * np.arccos(np.abs(pose[:, 3:] @ mean))) ** 2).mean())
    squared = (angle / about_mean) ** 2
    for x in (q, pose[:, :3]):
        squared += ((x[:, None] - x[None]) ** 2).sum(axis=2) / spread(x) ** 2
    expected = [0]
    while len(expected) < 12:
        expected.append(int(squared[:, expected].min(axis=1).argmax()))
    assert chosen.tolist() == expected


def test_diverse_ignores_the_sign_of_quaternions_and_constant_variables():
    pose = np.zeros((4, 7))
    pose[:, 3] = [1, -1, np.cos(0.4), -np.cos(0.1)]
    pose[:, 6] = [0, 0, np.sin(0.4), np.sin(0.1)]
    assert plain({"p": pose}, {"p": "pose"}).diverse(3).tolist() == [0, 2, 3]


def test_diverse_covers_clusters_and_gives_each_sample_once():
    rng = np.random.default_rng(1)
    centres = np.array([[0, 0], [10, 0], [0, 10], [10, 10.0]])
    q = (centres[:, None] + rng.normal(scale=0.1, size=(4, 50, 2))).reshape(-1, 2)
    samples = plain({"q": q}, {})
    assert sorted(samples.diverse(4) // 50) == [0, 1, 2, 3]
    assert sorted(samples.diverse(1000)) == list(range(200))
    same = plain({"q": np.zeros((5, 2))}, {})
    assert sorted(same.diverse(5)) == [0, 1, 2, 3, 4]


def test_kind_is_told_by_unit_quaternions():
    assert kind_of(np.array([[1, 2, 3, 0, 0.6, 0.8, 0], [0, 0, 0, 1, 0, 0, 0.0]])) == "pose"
    assert kind_of(np.ones((3, 7))) == "configuration"
    assert kind_of(np.ones((3, 8))) == "configuration"
