"""The folder that outlasts a process: what is found again, and what goes when it is full."""

import os

import pytest

from cgs_jax import cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "_folder", None)
    return cache.enable_disk_cache(tmp_path / "kept")


def test_the_default_folder_is_the_users(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_folder", None)
    assert cache.cache_folder() is None and cache.entry(".table", "a") is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.enable_disk_cache() == tmp_path / "cgs_jax" == cache.cache_folder()
    assert not (tmp_path / "cgs_jax").exists()


def test_entries_differ_by_their_parts_and_not_by_where_these_meet(folder):
    names = {cache.entry(".table", *parts) for parts in (("a", "bc"), ("ab", "c"), ("abc",), ("a", b"bd"))}
    assert len(names) == 4 and {name.parent for name in names} == {folder}
    assert cache.entry(".table", "a", b"bc") == cache.entry(".table", b"a", "bc")


def test_the_entries_used_longest_ago_go_first(folder, monkeypatch):
    monkeypatch.setattr(cache, "CACHE_BYTES", 250)
    entries = [cache.entry(suffix, suffix) for suffix in cache.SUFFIXES]
    folder.mkdir()
    (folder / "notes.txt").write_bytes(bytes(1000))
    for age, entry in zip((20, 10), entries, strict=True):
        cache.store(entry, bytes(100))
        os.utime(entry, (1e9 - age, 1e9 - age))
    assert cache.read(entries[0]) == bytes(100)  # now the other one is the oldest
    cache.store(cache.entry(".table", "new"), bytes(100))
    assert entries[0].exists() and not entries[1].exists() and (folder / "notes.txt").exists()


def test_what_cannot_be_written_is_not_kept(folder):
    folder.write_text("a file where the folder should be")
    cache.store(cache.entry(".table", "a"), b"data")
    assert folder.read_text().startswith("a file")
