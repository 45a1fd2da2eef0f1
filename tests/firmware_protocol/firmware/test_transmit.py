from firmware_protocol import _firmware
from firmware_protocol.protection import crc8

ffi, lib = _firmware.ffi, _firmware.lib


def queue():
    made = ffi.new("disco_transmit_t *")
    lib.disco_transmit_init(made)
    return made


def pop(made):
    frame = ffi.new("disco_frame_t *")
    return (frame.can_id, bytes(frame.data)) if lib.disco_transmit_pop(made, frame) else None


def test_first_in_first_out_with_the_crc_filled_in_over_many_laps():
    made = queue()
    for lap in range(100):
        for n in range(lap % 48):
            lib.disco_transmit_send(made, 0x100 + n, bytes((0, lap, n, 0, 0, 0, 0, 0)), 0x910)
        for n in range(lap % 48):
            can_id, data = pop(made)
            assert (can_id, data[1:3]) == (0x100 + n, bytes((lap, n)))
            assert data[0] == crc8(data[1:], 0x910)
        assert pop(made) is None
    assert made.overflow_count == 0


def test_the_frame_that_does_not_fit_is_dropped_and_counted():
    made = queue()
    for n in range(50):
        lib.disco_transmit_send(made, n, bytes(8), 0)
    assert made.overflow_count == 2
    assert [pop(made)[0] for _ in range(48)] == list(range(48))
    assert pop(made) is None


def test_each_message_has_its_own_counter_modulo_16():
    made = queue()
    assert [lib.disco_transmit_counter(made, 3) for _ in range(18)] == [*range(16), 0, 1]
    assert lib.disco_transmit_counter(made, 4) == 0


def test_a_frame_has_eight_bytes_and_says_so():
    made = queue()
    lib.disco_transmit_send(made, 0x100, bytes(8), 0x910)
    assert made.frames[1].can_id == 0, "nothing is written behind it"
    frame = ffi.new("disco_frame_t *")
    assert lib.disco_transmit_pop(made, frame)
    assert frame.length == 8
