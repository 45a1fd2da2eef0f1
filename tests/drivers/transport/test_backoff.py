from drivers.transport.backoff import BackoffPolicy, next_delay_s

POLICY = BackoffPolicy(first_s=0.1, longest_s=1.0, steady_s=5.0)


def test_delays_double_up_to_the_longest():
    delays = []
    delay = None
    for _ in range(6):
        delay = next_delay_s(POLICY, delay, up_for_s=0.0)
        delays.append(delay)
    assert delays == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_steady_link_starts_afresh_and_a_flapping_one_does_not():
    assert next_delay_s(POLICY, 0.8, up_for_s=5.0) == 0.1
    assert next_delay_s(POLICY, 0.4, up_for_s=4.9) == 0.8
