"""A little of the campaign, and proof that it would tell."""

import random

import pytest

from tools import fuzz


@pytest.fixture(autouse=True)
def _in_a_place_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_hostile_files_are_read_or_refused_in_one_line(tmp_path):
    assert fuzz.attack(4.0, 1, tmp_path) == []


@pytest.mark.parametrize(
    ("error", "words"),
    [(IndexError("out of range"), "IndexError"), (fuzz.InputError("first\nsecond"), "more than one line")],
)
def test_what_gets_through_is_told_and_the_file_kept(tmp_path, monkeypatch, error, words):
    def fail(path):
        raise error

    monkeypatch.setitem(fuzz.READERS, "faults.toml", fail)
    wrong = fuzz.attack(0.01, 1, tmp_path, only="faults.toml")
    assert words in wrong[0]
    assert (tmp_path / wrong[0].partition(":")[0]).exists()


def test_good_files_are_good(tmp_path):
    for name, good in fuzz.good_files().items():
        (tmp_path / name).write_bytes(good)
        fuzz.READERS[name](tmp_path / name)


def test_most_mutants_differ_and_the_same_seed_makes_the_same():
    good = fuzz.FAULTS.encode()
    mutants = [fuzz.mutated(good, random.Random(seed)) for seed in range(100)]
    assert sum(mutant != good for mutant in mutants) > 90
    assert mutants == [fuzz.mutated(good, random.Random(seed)) for seed in range(100)]
