"""A daemon of which only the control socket is there, served by a thread of the test."""

import threading

from disco_hw.daemon import SERVED
from disco_hw.daemon.control_socket import ControlServer


class ControlDaemon:
    """Gives each request the reply `reply(message)` and keeps what was requested; it can be made to hang."""

    def __init__(self, path, reply):
        self.server = ControlServer(path, SERVED)
        self.received, self.hangs = [], False
        self._reply, self._ending = reply, threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._ending.wait(0.002):
            for message in [] if self.hangs else self.server.poll():
                self.received.append((message.action, message.arguments))
                self.server.reply(message, self._reply(message))

    def actions(self, *but):
        """What was requested in turn, without these actions."""
        return [action for action, _ in self.received if action not in but]

    def close(self):
        self._ending.set()
        self._thread.join()
        self.server.close()
