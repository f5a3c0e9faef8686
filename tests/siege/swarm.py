"""Many connections at a time, driven by one thread."""

import errno
import selectors
import socket
import threading
import time

import http2


class Swarm(threading.Thread):
    """Keeps `count` connections open. Each sends `greeting`. If `answers` is set, it then answers PINGs and SETTINGS.
    Opens a new connection for each that the server closes, at most `total` in all."""

    def __init__(self, port, count, greeting, answers=True, total=None):
        super().__init__(daemon=True)
        self.port = port
        self.count = count
        self.greeting = greeting
        self.answers = answers
        self.total = total
        self.selector = selectors.DefaultSelector()
        self.connecting = 0
        # The frame reader of each connection. None while the connection is being established.
        self.open = {}
        self.opened = 0
        # The error codes of all received GOAWAY frames.
        self.goaways = []
        self.is_stopped = False

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.is_stopped = True
        self.join()
        for connection in list(self.open):
            self.drop(connection)
        self.selector.close()

    def wait_until_open(self, count, timeout):
        """Waits until `count` connections have been opened in all. Returns the number of those that were."""
        deadline = time.monotonic() + timeout
        while self.opened < count and time.monotonic() < deadline:
            time.sleep(0.02)
        return self.opened

    def run(self):
        while not self.is_stopped:
            self.connect_more()
            for key, events in self.selector.select(0.01):
                self.handle(key.fileobj, events)

    def wants_more(self):
        """Whether to open another connection. At most 64 are established at a time."""
        if self.total is not None and self.opened + self.connecting >= self.total:
            return False
        return len(self.open) < self.count and self.connecting < 64

    def connect_more(self):
        while self.wants_more():
            connection = socket.socket()
            connection.setblocking(False)
            code = connection.connect_ex(("127.0.0.1", self.port))
            if code not in (0, errno.EINPROGRESS):
                connection.close()
                return
            self.connecting += 1
            self.open[connection] = None
            self.selector.register(connection, selectors.EVENT_WRITE)

    def handle(self, connection, events):
        try:
            if events & selectors.EVENT_WRITE:
                self.connecting -= 1
                if connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                    return self.drop(connection)
                self.opened += 1
                self.open[connection] = http2.FrameReader()
                connection.sendall(self.greeting)
                self.selector.modify(connection, selectors.EVENT_READ)
                return
            data = connection.recv(1 << 16)
            if not data:
                return self.drop(connection)
            frames = self.open[connection].feed(data)
            self.goaways += [
                int.from_bytes(payload[4:8], "big") for kind, _, _, payload in frames if kind == http2.GOAWAY
            ]
            if self.answers and (reply := http2.answer(frames)):
                connection.sendall(reply)
        except OSError:
            self.drop(connection)

    def drop(self, connection):
        if connection not in self.open:
            return
        del self.open[connection]
        self.selector.unregister(connection)
        connection.close()
