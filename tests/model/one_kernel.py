"""Terms of each kind, all of them in every model, so that one kernel is compiled; at zero a term adds nothing."""

from disco_hw.model import EffectSetting

BASE = (0.06, 0.4, 0.1)
DROOP = "command += k u |u|"
DIRECTION, LOAD = "command += k sign(u - mean_0.3s(u))", "command += k u mean_1s(|u| + |u_other|)"
DRAG, SLIPPING = "v_x += k v^3", "v_x += k (v - slewed_2(v))"
ASIDE = "v_y += k omega^3"
SPIN, RUBBER = "omega += k omega", "omega += k (omega - mean_1s(omega))"
TERMS = (DROOP, DIRECTION, LOAD, DRAG, SLIPPING, ASIDE, SPIN, RUBBER)


def effects_of(numbers, reaches=None, lag_s=0.0):
    """All terms, with these numbers and reaches by name, behind a lag."""
    far = {name: {"reach": reach} for name, reach in (reaches or {}).items()}
    terms = (EffectSetting(name, {"k": numbers.get(name, 0.0), **far.get(name, {})}) for name in TERMS)
    return EffectSetting("motor_lag", {"tau_s": lag_s}), *terms
