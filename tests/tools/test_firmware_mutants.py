"""The sweep itself takes more than an hour (`make firmware-mutants`); here, that its list of exceptions is sound."""

import tomllib

from tools.check.mutation import mutants
from tools.firmware_mutants import EQUIVALENTS, FIRMWARE, HAND_WRITTEN


def test_every_listed_equivalent_is_still_a_mutant_and_has_its_reason():
    listed = tomllib.loads(EQUIVALENTS.read_text("utf-8"))
    assert set(listed) <= set(HAND_WRITTEN)
    for name, reasons in listed.items():
        keys = {mutant.key for mutant in mutants((FIRMWARE / name).read_text("utf-8"))}
        assert set(reasons) <= keys, "the line has changed: judge the mutant anew"
        assert all(len(reason.split()) >= 4 for reason in reasons.values())
