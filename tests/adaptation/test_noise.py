import pytest

from disco_hw.adaptation.recursive import RunningNoise
from disco_hw.inference.excitation import USUAL, Noise

OTHER = Noise(0.02, 0.03, 0.02, 0.02, 0.05)


def test_begins_as_usual():
    assert RunningNoise().noise.vector() == pytest.approx(USUAL.vector())


def test_one_stretch_moves_it_a_little_and_many_all_the_way():
    running = RunningNoise()
    running.add(OTHER)
    assert USUAL.position_m < running.noise.position_m < 0.6 * OTHER.position_m
    for _ in range(60):
        running.add(OTHER)
    assert running.noise.vector() == pytest.approx(OTHER.vector(), rel=0.01)
