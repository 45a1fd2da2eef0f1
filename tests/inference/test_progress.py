from disco_hw.inference.simulate import Tally


def test_stages_and_shares_are_told_as_simulations_are_counted():
    told = []
    tally = Tally(10, lambda stage, share: told.append((stage, share)))
    tally.stage("first")
    tally.add(4)
    tally.stage("second")
    tally.add(8)
    assert told == [("first", 0.0), ("first", 0.4), ("second", 0.4), ("second", 1.0)]
