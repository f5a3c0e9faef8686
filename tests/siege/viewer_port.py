"""Item 14: the viewer's port withstands other web pages, slow heads, hostile frames and viewers that never read."""

import socket
import tempfile
import threading
import time
from pathlib import Path

import websocket
from client import DESCRIBE_SCENE, HEALTH_WATCH, Client, scenes_pb2, slowest_service, time_to_serve
from connections import stopped_server
from floods import check_floods
from replies import ALL_ARRAYS
from report import Result, mb
from scenes import write_grid
from server import Peak, Server
from websocket import WebSocket

ITEM = 14

# Seconds within which a new client must be served.
MAX_SERVICE_SECONDS = 1.0

# Seconds within which a connection must end whose HTTP head arrives one byte at a time.
MAX_HEAD_SECONDS = 15

# The limit on connections of the server.
CONNECTIONS = 1024

# Each of HALF_SENT_CONNECTIONS connections sends a part of a message of HALF_SENT_BYTES. The memory may
# grow by MAX_HALF_SENT_MEMORY bytes.
HALF_SENT_CONNECTIONS = 48
HALF_SENT_BYTES = 12 << 20
MAX_HALF_SENT_MEMORY = 256 << 20

# Vertices per side of the scene that is described.
SIDE = 400

# Each of UNREAD_CONNECTIONS connections opens UNREAD_CALLS calls and reads nothing for DURATION seconds. The memory may
# grow by MAX_UNREAD_MEMORY bytes.
UNREAD_CONNECTIONS = 32
UNREAD_CALLS = 32
MAX_UNREAD_MEMORY = 384 << 20
DURATION = 12.0

# Flags that raise the budgets to their largest values.
UNLIMITED = ["--receive-bytes", "4000000000"]
UNLIMITED += ["--connection-reply-bytes", "4000000000", "--reply-bytes", "4000000000"]


def other_pages(program):
    """Requests that a page of another site can make, and guesses of a link's code."""
    with Server(program) as server:
        own = server.address  # The host that the viewer accepts.
        requests = [
            websocket.request(server, "/session", own, f"http://{own}", body=code)
            for code in ["", "0" * 64, "x" * 512, "1123456789abcdef"]
        ]
        for path, upgrade in [("/", False), ("/websocket", True), ("/recording", False)]:
            for host, origin in [
                ("evil.example", None),
                (f"evil.example:{server.port}", f"http://evil.example:{server.port}"),
                (own, "http://evil.example"),
                (own, "null"),
                (own, f"https://{own}"),
                (own, f"http://localhost:{server.port + 1}"),
            ]:
                requests.append(websocket.request(server, path, host, origin, upgrade))
        requests.append(websocket.request(server, "/session", own, "http://evil.example", body="0" * 64))
        answers = [websocket.status_of(server, request) for request in requests]
        control = [
            websocket.status_of(server, websocket.request(server, "/")),
            websocket.status_of(server, websocket.request(server, "/websocket", own, f"http://{own}", True)),
        ]
    return Result(
        ITEM,
        "web pages of other sites and wrong codes get neither the viewer, a session nor a WebSocket",
        f"403 for {len(answers)} requests",
        ", ".join(f"{answers.count(status)} x {status}" for status in sorted(set(answers))),
        set(answers) == {403},
        f"own page and WebSocket: {control}",
        control == [200, 101],
    )


def lockout(program, connect):
    """The slowest service while CONNECTIONS connections that `connect` opens exist."""
    with Server(program) as server:
        connections = []
        for _ in range(CONNECTIONS):
            try:
                connections.append(connect(server))
            except OSError:
                pass
        slowest = slowest_service(server, 5, 4)
        for connection in connections:
            connection.close()
        return slowest


def slow_head(server):
    """Sends an incomplete HTTP head."""
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=10)
    connection.sendall("GET / HTTP/1.1\r\nHost: ".encode())
    return connection


def silent_websocket(server):
    return WebSocket(server)


def websocket_with_a_call(server):
    connection = WebSocket(server)
    connection.send(websocket.start_call(1, HEALTH_WATCH, b""))
    return connection


def trickled_head(program):
    """Sends an HTTP head one byte at a time. Returns the seconds until the server ends the connection."""
    with Server(program) as server:
        connection, start = slow_head(server), time.monotonic()
        try:
            while time.monotonic() - start < 60:
                connection.sendall(b"x")
                time.sleep(0.25)
        except OSError:
            pass
        return time.monotonic() - start


def slow_clients(program):
    heads = lockout(program, slow_head)
    silent = lockout(program, silent_websocket)
    seconds = trickled_head(program)
    watching = lockout(program, websocket_with_a_call)
    control = stopped_server(program)
    return Result(
        ITEM,
        f"{CONNECTIONS} slow HTTP heads or WebSockets that do not work do not lock out a new client, and slow heads end",
        f"served within {MAX_SERVICE_SECONDS:.0f} s, a trickled head closed within {MAX_HEAD_SECONDS} s",
        f"slow heads {heads:.2f} s, silent WebSockets {silent:.2f} s, WebSockets with a Health.Watch {watching:.2f} s, "
        f"trickled head closed after {seconds:.1f} s",
        max(heads, silent, watching) <= MAX_SERVICE_SECONDS and seconds <= MAX_HEAD_SECONDS,
        f"a server that is stopped: {control:.2f} s",
        control > MAX_SERVICE_SECONDS,
    )


def send_half(connection, is_fragmented):
    """Sends 11 of 12 parts of a message, each in a frame of its own or all in one frame."""
    part = bytes(HALF_SENT_BYTES // 12)
    try:
        for index in range(11):
            if is_fragmented:
                opcode = websocket.BINARY if index == 0 else websocket.CONTINUATION
                connection.send(websocket.frame(opcode, part, is_last=False))
            elif index == 0:
                connection.send(websocket.frame(websocket.BINARY, part, claimed=HALF_SENT_BYTES))
            else:
                connection.send(part)
    except OSError:
        pass


def half_sent(program, flags):
    """Growth of the memory during half-sent messages, and the slowest service."""
    with Server(program, *flags) as server:
        for _ in range(3):
            time_to_serve(server, 10)
        memory, slowest = Peak(server.memory), 0.0
        connections = [WebSocket(server) for _ in range(HALF_SENT_CONNECTIONS)]
        targets = [(connection, index % 2 == 0) for index, connection in enumerate(connections)]
        threads = [threading.Thread(target=send_half, args=target) for target in targets]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            slowest = max(slowest, slowest_service(server, 0.1, 5, pause=0.02))
            memory.sample()
        memory.sample()
        for connection in connections:
            connection.close()
        return memory.growth(), slowest


def half_sent_messages(program):
    growth, slowest = half_sent(program, [])
    control, _ = half_sent(program, UNLIMITED)
    return Result(
        ITEM,
        f"{HALF_SENT_CONNECTIONS} half-sent fragmented WebSocket messages of {mb(HALF_SENT_BYTES)} use bounded memory",
        f"memory +{mb(MAX_HALF_SENT_MEMORY)}, new client served within {MAX_SERVICE_SECONDS:.0f} s",
        f"+{mb(growth)}, served within {slowest:.2f} s",
        growth <= MAX_HALF_SENT_MEMORY and slowest <= MAX_SERVICE_SECONDS,
        f"with the largest budgets +{mb(control)}",
        control > MAX_HALF_SENT_MEMORY,
    )


def describe_whole(server, request):
    """Seconds in which a new client receives a description."""
    start = time.monotonic()
    with Client(server) as client:
        for _ in client.scenes.DescribeScene(request, timeout=60):
            pass
    return time.monotonic() - start


def unread(program, flags):
    """Growth of the memory while viewers read nothing, and the slowest description for another client."""
    description = scenes_pb2.DescribeSceneRequest(scene="grid", arrays=ALL_ARRAYS)
    request = description.SerializeToString()
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", SIDE)
        with Server(program, *flags, scenes=folder) as server:
            with Client(server) as client:
                client.open_scene("grid.obj", "grid")
            describe_whole(server, description)
            memory, slowest = Peak(server.memory), 0.0
            connections = [WebSocket(server, receive_buffer=4096) for _ in range(UNREAD_CONNECTIONS)]
            for connection in connections:
                for call in range(UNREAD_CALLS):
                    connection.send(websocket.start_call(call + 1, DESCRIBE_SCENE, request))
            end = time.monotonic() + DURATION
            while time.monotonic() < end:
                slowest = max(slowest, describe_whole(server, description))
                memory.sample()
                time.sleep(0.05)
            for connection in connections:
                connection.close()
            return memory.growth(), slowest


def unread_replies(program):
    growth, slowest = unread(program, [])
    control, _ = unread(program, UNLIMITED)
    return Result(
        ITEM,
        f"{UNREAD_CONNECTIONS * UNREAD_CALLS} unread calls of viewers use bounded memory, and another client is served",
        f"memory +{mb(MAX_UNREAD_MEMORY)}, a description within {MAX_SERVICE_SECONDS:.0f} s",
        f"+{mb(growth)}, {slowest:.2f} s",
        growth <= MAX_UNREAD_MEMORY and slowest <= MAX_SERVICE_SECONDS,
        f"with the largest budgets +{mb(control)}",
        control > MAX_UNREAD_MEMORY,
    )


EMPTY_FRAGMENT = websocket.frame(websocket.CONTINUATION, b"", is_last=False)

FLOODS = [
    ("PING", websocket.frame(websocket.PING, bytes(8))),
    ("empty fragments", EMPTY_FRAGMENT),
    ("CREDIT", websocket.message(1, websocket.CREDIT, bytes(4))),
]


def connect_for_flood(server, frame):
    """A WebSocket with an open call, so that it has a message to continue and to give credit to."""
    connection = WebSocket(server)
    connection.send(websocket.start_call(1, HEALTH_WATCH, b""))
    if frame == EMPTY_FRAGMENT:
        connection.send(websocket.frame(websocket.BINARY, b"", is_last=False))
    return connection


def small_frames(program):
    promise = "floods of small WebSocket frames end their connection"
    with Server(program) as server:
        return check_floods(ITEM, promise, server, FLOODS, lambda frame: connect_for_flood(server, frame))


def run(program):
    checks = [other_pages, slow_clients, half_sent_messages, unread_replies, small_frames]
    return [check(program) for check in checks]
