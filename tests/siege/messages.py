"""Item 2 of `prove.py`: half-sent messages hold a bounded number of bytes, for a bounded time."""

import threading

import http2
from client import LIST_SCENES, slowest_service, time_to_serve
from report import Result, mb
from server import Peak, Server

ITEM = 2

# Each of CONNECTIONS connections opens CALLS calls. A call claims a message of CLAIMED_BYTES and sends SENT_BYTES of
# it.
CONNECTIONS = 4
CALLS = 128
CLAIMED_BYTES = 16 << 20
SENT_BYTES = (2 << 20) - 4096

# Limits on the growth in bytes: of the memory and of the address space during the attack, and of the memory after it.
MAX_PEAK = 256 << 20
MAX_ADDRESS_SPACE = 1 << 30
MAX_REST = 32 << 20

# Seconds within which a new client must be served.
MAX_SERVICE_SECONDS = 1.0

# Seconds after which the server ends a message without progress.
MESSAGE_TIMEOUT = 10

# Flags that raise the budgets to their largest values.
UNLIMITED = ["--receive-bytes", "4000000000"]


def send_half(connection):
    """Opens calls and sends a part of a message on each, until the server closes the connection."""
    part = http2.grpc_message(bytes(SENT_BYTES), CLAIMED_BYTES)
    try:
        for _ in range(CALLS):
            connection.send_data(connection.open_call(LIST_SCENES), part)
        # Read the errors, so that the server can send them.
        connection.receive(MESSAGE_TIMEOUT + 5)
    except OSError:
        pass


def attack(program, flags):
    """Growth of memory and address space during the attack, growth of memory after it, and the slowest service."""
    with Server(program, *flags) as server:
        for _ in range(3):
            time_to_serve(server, 10)
        memory, addresses = Peak(server.memory), Peak(lambda: server.memory("VmSize"))
        attackers = [http2.Connection(server.port) for _ in range(CONNECTIONS)]
        threads = [threading.Thread(target=send_half, args=[attacker]) for attacker in attackers]
        for thread in threads:
            thread.start()
        slowest = 0.0
        while any(thread.is_alive() for thread in threads):
            slowest = max(slowest, slowest_service(server, 0.1, 5, pause=0.02))
            memory.sample()
            addresses.sample()
        peaks = memory.growth(), addresses.growth()
        # The attackers are still connected. Their messages have ended.
        rest = server.memory() - memory.first
        for attacker in attackers:
            attacker.close()
        return *peaks, rest, slowest


def run(program):
    peak, addresses, rest, slowest = attack(program, [])
    control, _, _, _ = attack(program, UNLIMITED)
    return [
        Result(
            ITEM,
            f"{CONNECTIONS * CALLS} half-sent messages of {mb(CLAIMED_BYTES)} use bounded memory, and it is given back",
            f"memory +{mb(MAX_PEAK)}, after {MESSAGE_TIMEOUT + 5} s +{mb(MAX_REST)}, "
            f"address space +{mb(MAX_ADDRESS_SPACE)}, new client served within {MAX_SERVICE_SECONDS:.0f} s",
            f"+{mb(peak)}, then +{mb(rest)}, address space +{mb(addresses)}, served within {slowest:.2f} s",
            peak <= MAX_PEAK and rest <= MAX_REST and addresses <= MAX_ADDRESS_SPACE and slowest <= MAX_SERVICE_SECONDS,
            f"with the largest budgets +{mb(control)}",
            control > MAX_PEAK,
        )
    ]
