from disco_hw.inference.simulate import Tally


def test_stages_and_shares_are_told_as_simulations_are_counted():
    reports = []
    tally = Tally(10, lambda stage, share: reports.append((stage, share)))
    tally.stage("first")
    tally.add(4)
    tally.stage("second")
    tally.add(8)
    assert reports == [("first", 0.0), ("first", 0.4), ("second", 0.4), ("second", 1.0)]
