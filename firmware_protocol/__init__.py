"""Protocol on the wire: the DBC, its codec, end-to-end protection, serial framing and the reference firmware."""
