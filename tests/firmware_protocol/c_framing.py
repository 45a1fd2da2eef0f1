"""The C side of the serial framing and of SLCAN, with the faces of Python's."""

from firmware_protocol import _firmware
from firmware_protocol.serial_framing import FrameDecoderStats

lib, ffi = _firmware.lib, _firmware.ffi


def c_frame(can_id, data):
    frame = ffi.new("disco_frame_t *", {"can_id": can_id, "length": len(data)})
    ffi.buffer(frame.data)[0 : len(data)] = data
    return frame


def encode_frame(can_id, data):
    # Beyond the room it is given, nothing may be written.
    line = ffi.new("uint8_t[]", b"\xee" * 20)
    count = lib.disco_serial_encode(c_frame(can_id, data), line)
    assert count <= 15
    assert bytes(line[count:20]) == b"\xee" * (20 - count)
    return bytes(line[0:count])


def received(feed, state, line):
    """The frames that C takes from these bytes."""
    frames, frame = [], ffi.new("disco_frame_t *")
    for byte in line:
        if feed(state, byte, frame):
            frames.append((frame.can_id, bytes(frame.data)[: frame.length]))
    return frames


class FrameDecoder:
    def __init__(self):
        self._decoder = ffi.new("disco_serial_decoder_t *")
        self._bytes = 0
        lib.disco_serial_init(self._decoder)

    def feed(self, line):
        self._bytes += len(line)
        return received(lib.disco_serial_feed, self._decoder, line)

    @property
    def _pending(self):
        return bytes(self._decoder.pending)[: self._decoder.count - 1]

    @property
    def stats(self):
        d = self._decoder
        return FrameDecoderStats(
            d.frames, self._bytes, d.stuffing_errors, d.crc_errors, d.length_errors, d.unknown_kind
        )


class Slcan:
    def __init__(self):
        self.line = ffi.new("disco_slcan_t *")
        lib.disco_slcan_init(self.line)

    def feed(self, text):
        """Return the frames that were for the robot, and the replies."""
        frames = received(lib.disco_slcan_feed, self.line, text)
        replies = ffi.new("uint8_t[22]")
        return frames, bytes(replies[0 : lib.disco_slcan_reply(self.line, replies)])

    def encode(self, can_id, data):
        text = ffi.new("uint8_t[22]")
        return bytes(text[0 : lib.disco_slcan_encode(self.line, c_frame(can_id, data), text)])
