import tomllib

from tools.check.mutation import mutants
from tools.firmware_mutants import EQUIVALENTS, FIRMWARE, HAND_WRITTEN


def changes(source):
    return [(mutant.old, mutant.new) for mutant in mutants(source)]


def test_comparisons_and_logic():
    assert changes("if (a < b && !c) {") == [("<", "<="), ("<", ">="), ("&&", "||"), ("!", "")]
    assert changes("a == b || c != d") == [("==", "!="), ("||", "&&"), ("!=", "==")]


def test_constants_go_up_and_down_but_not_below_zero():
    assert changes("x = 0x0Fu;") == [("0x0Fu", "16u"), ("0x0Fu", "14u")]
    assert changes("x = 0u;") == [("0u", "1u")]
    assert changes("x = 2.0f;") == [("2.0f", "2.04f"), ("2.0f", "1.96f")]
    assert changes("x = 1.0e-6f;")[0] == ("1.0e-6f", "1.02e-06f")


def test_arithmetic_masks_and_shifts():
    assert changes("a + b") == [("+", "-")]
    assert changes("a += b << c") == [("+=", "-="), ("<<", ">>")]
    assert changes("p->x++") == [("++", "--")]


def test_what_is_no_code_is_left_alone():
    assert changes('/* a < b */ "a < b" // 1 + 1\n#include "a-b.h"') == []


def test_a_row_of_a_table_is_changed_one_way():
    assert len(changes("    " + ", ".join(f"0x{i:02X}u" for i in range(16)) + ",")) == 16


def test_each_is_applied_at_its_place_and_named_by_its_line():
    source = "a = 1u;\nb = a  -  1u;\n"
    mutant = next(mutant for mutant in mutants(source) if mutant.old == "-")
    assert mutant.apply(source) == "a = 1u;\nb = a  +  1u;\n"
    assert (mutant.line, mutant.key) == (2, "b = a «-» 1u; [- -> +]")


# The sweep itself takes more than an hour (`make firmware-mutants`).
def test_every_listed_equivalent_is_still_a_mutant_and_has_its_reason():
    listed = tomllib.loads(EQUIVALENTS.read_text("utf-8"))
    assert set(listed) <= set(HAND_WRITTEN)
    for name, reasons in listed.items():
        keys = {mutant.key for mutant in mutants((FIRMWARE / name).read_text("utf-8"))}
        assert set(reasons) <= keys, "the line has changed: judge the mutant anew"
        assert all(len(reason.split()) >= 4 for reason in reasons.values())
