"""Item 19: clients share what a scene can hold, so that one client does not lock out the others."""

import tempfile
import threading
import time
from pathlib import Path

import grpc
from client import GET_STATE, Client, Writer, common_pb2, states_pb2
from report import Result
from scenes import write_grid
from server import Server

ITEM = 19

# The limit on the streams of a scene. Each of ATTACKERS connections asks for this number.
STREAMS = 32
ATTACKERS = 3

# The same for the requests that wait for a step of a scene.
REQUESTS = 64

STREAM_STATES = "/modalcast.v1.StateService/StreamStates"


class Stream(threading.Thread):
    """A call that answers with messages. Counts them until the call ends."""

    def __init__(self, client, method, request):
        super().__init__(daemon=True)
        self.replies = client.channel.unary_stream(method)(request.SerializeToString())
        self.count, self.code = 0, None
        # Set by the first message, or by the error of a call that is refused.
        self.has_begun = threading.Event()
        self.start()

    def run(self):
        try:
            for _ in self.replies:
                self.count += 1
                self.has_begun.set()
        except grpc.RpcError as error:
            self.code = error.code()
        self.has_begun.set()

    def is_open(self):
        self.has_begun.wait(10)
        return self.code is None


def stream_states(client):
    request = states_pb2.StreamStatesRequest(scene="grid", delivery=common_pb2.DELIVERY_LATEST)
    return Stream(client, STREAM_STATES, request)


def attack_streams(server):
    """Of a client that has a stream, of a new client, and of the attackers: the number of open streams; and whether the
    first two received a step."""
    with Client(server) as owner, Client(server) as early, Client(server) as late:
        owner.open_scene("grid.obj", "grid")
        writer = Writer(owner, "grid")
        kept = stream_states(early)
        kept.is_open()
        attackers = [Client(server) for _ in range(ATTACKERS)]
        streams = [stream_states(attacker) for attacker in attackers for _ in range(STREAMS)]
        for stream in streams:
            stream.is_open()
        new = stream_states(late)
        is_admitted = new.is_open()
        before = [kept.count, new.count]
        for _ in range(50):
            writer.step()
        time.sleep(0.5)
        received = [stream.count > count for stream, count in zip([kept, new], before)]
        still_open = sum(stream.is_open() for stream in streams)
        # The client that holds the most is the one that the limit refuses.
        refused = not stream_states(attackers[0]).is_open()
        for attacker in attackers:
            attacker.channel.close()
        return kept.is_open(), is_admitted, received, still_open, refused


def wait_for_step(client):
    """Begins a request for a step that is never sent."""
    step = common_pb2.StepSelector(minimum=1 << 40)
    request = states_pb2.GetStateRequest(scene="grid", step=step, deadline_ms=600_000)
    return Stream(client, GET_STATE, request)


def attack_requests(server):
    """Whether a new client gets the state, whether the request of another client still waits, the number of waiting
    requests of the attackers, and whether one more of an attacker is refused."""
    with Client(server) as owner, Client(server) as early, Client(server) as late:
        owner.open_scene("grid.obj", "grid")
        kept = wait_for_step(early)
        attackers = [Client(server) for _ in range(ATTACKERS)]
        waiting = [wait_for_step(attacker) for attacker in attackers for _ in range(REQUESTS)]
        time.sleep(2)
        new = Stream(late, GET_STATE, states_pb2.GetStateRequest(scene="grid", deadline_ms=5000))
        new.join(10)
        more = wait_for_step(attackers[0])
        more.join(1)
        still_waiting = sum(stream.is_alive() for stream in waiting)
        for attacker in attackers:
            attacker.channel.close()
        return new.count > 0, kept.is_alive(), still_waiting, more.code is not None


def run(program):
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", 2)
        with Server(program, scenes=folder) as server:
            is_kept, is_admitted, received, still_open, refused = attack_streams(server)
            is_answered, still_waits, waiting, request_refused = attack_requests(server)
    return [
        Result(
            ITEM,
            f"{ATTACKERS} connections ask for {STREAMS} streams of a scene each, which admits {STREAMS}",
            "a new client gets a stream, that of another client stays open, and both receive steps",
            f"{'admitted' if is_admitted else 'refused'}, {'open' if is_kept else 'ended'}, "
            f"{received.count(True)} of 2 receive steps; {still_open} of the attackers are open",
            is_admitted and is_kept and all(received),
            f"one more stream of an attacker: {'refused' if refused else 'admitted'}",
            refused,
        ),
        Result(
            ITEM,
            f"{ATTACKERS} connections send {REQUESTS} requests for a future step each, of which {REQUESTS} may wait",
            "a new client gets the state, and the request of another client still waits",
            f"{'answered' if is_answered else 'refused'}, {'waits' if still_waits else 'ended'}; {waiting} of the "
            "attackers wait",
            is_answered and still_waits,
            f"one more request of an attacker: {'refused' if request_refused else 'admitted'}",
            request_refused,
        ),
    ]
