"""Item 14: hostile recordings are refused with the reason by `modalcast export`, `recover` and `replay`, which start
`modalcast-record`."""

import dataclasses
import struct
import subprocess
import tempfile
from pathlib import Path

import measured
from client import Client, scenes_pb2
from report import Result, mb
from server import Server

ITEM = 14

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, CHUNK_INDEX, METADATA_INDEX, FOOTER = 5, 6, 8, 13, 2

# Limits of one command: seconds and bytes of memory.
MAX_SECONDS = 10
MAX_MEMORY = 256 << 20

# Bytes of a chunk that decompresses from 2 KB, and the times that the index names it.
BOMB_BYTES = 64 << 20
BOMB_REPEATS = 2000

# Exit codes of a command that refuses its input with the reason.
REFUSED = (3, 4, 5)


def records(data, start, end):
    """The records (opcode, offset, body) between two offsets."""
    while start < end:
        opcode, length = struct.unpack_from("<BQ", data, start)
        yield opcode, start, data[start + 9 : start + 9 + length]
        start += 9 + length


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


@dataclasses.dataclass
class Recording:
    """A valid file in two parts: the data, and the records of the summary."""

    data: bytes
    summary: list

    @classmethod
    def parse(cls, data):
        end = len(data) - len(MAGIC) - 29
        start = struct.unpack_from("<Q", data, end + 9)[0]
        return cls(data[:start], [(opcode, body) for opcode, _, body in records(data, start, end)])

    def join(self, data=None, summary=None):
        data = self.data if data is None else data
        summary = self.summary if summary is None else summary
        footer = record(FOOTER, struct.pack("<QQI", len(data), 0, 0))
        return data + b"".join(record(*entry) for entry in summary) + footer + MAGIC

    def changed(self, opcode, change):
        """The file with the first record of a kind in the summary changed."""
        summary = list(self.summary)
        index = next(index for index, (kind, _) in enumerate(summary) if kind == opcode)
        summary[index] = (opcode, change(summary[index][1]))
        return self.join(summary=summary)


def zstd_of_zeros(head, size):
    """A zstd frame of `size` bytes: `head`, then zeros, which take 4 bytes per 128 KiB."""
    blocks = [struct.pack("<I", len(head) << 3)[:3] + head]
    rest = size - len(head)
    while rest > 0:
        part = min(rest, 128 << 10)
        rest -= part
        # Type 1 repeats one byte. Bit 0 is set for the last block.
        blocks.append(struct.pack("<I", part << 3 | 1 << 1 | (rest == 0))[:3] + b"\0")
    # The frame has a window of 128 MiB and no size of its content.
    return b"\x28\xb5\x2f\xfd" + b"\x00" + bytes([17 << 3]) + b"".join(blocks)


def chunk(compressed, size):
    """A chunk record without a checksum."""
    head = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(compressed))
    return record(CHUNK, head + compressed)


def chunk_index(offset, length):
    times, empty_map, sizes = bytes(16), bytes(4), struct.pack("<Q", 0)
    return times + struct.pack("<QQ", offset, length) + empty_map + sizes + struct.pack("<I", 4) + b"zstd" + bytes(16)


def hostile_files(valid):
    """Names and contents."""
    recording = Recording.parse(valid)
    # One message of an unknown channel that fills the chunk.
    bomb = zstd_of_zeros(struct.pack("<BQH", MESSAGE, BOMB_BYTES - 9, 999), BOMB_BYTES)
    appended = recording.data + chunk(bomb, BOMB_BYTES)
    index = chunk_index(len(recording.data), len(appended) - len(recording.data))
    larger = recording.data + chunk(zstd_of_zeros(b"", 1 << 32), 1 << 32)
    larger_index = chunk_index(len(recording.data), len(larger) - len(recording.data))
    first_chunk = next(
        offset for opcode, offset, _ in records(recording.data, len(MAGIC), len(recording.data)) if opcode == CHUNK
    )
    huge = recording.data[: first_chunk + 1] + struct.pack("<Q", 1 << 62) + recording.data[first_chunk + 9 :]
    text = b"modalcast.v1.StreamStatesResponse"
    return {
        "empty": b"",
        "magic only": MAGIC,
        "cut in the first chunk": valid[: first_chunk + 40],
        "cut in the index": valid[: len(recording.data) + 50],
        "record of 2^62 bytes": recording.join(huge),
        "chunk index repeated": recording.join(
            summary=recording.summary + [e for e in recording.summary if e[0] == CHUNK_INDEX]
        ),
        "chunk of 64 MiB named 2,000 times": recording.join(
            appended, recording.summary + [(CHUNK_INDEX, index)] * BOMB_REPEATS
        ),
        "chunk of 4 GiB": recording.join(larger, recording.summary + [(CHUNK_INDEX, larger_index)]),
        "chunk beyond the file": recording.changed(
            CHUNK_INDEX, lambda body: body[:16] + struct.pack("<QQ", 1 << 60, 1 << 60) + body[32:]
        ),
        "metadata named twice": recording.join(
            summary=recording.summary + [e for e in recording.summary if e[0] == METADATA_INDEX]
        ),
        "wrong schemas": valid.replace(text, text[::-1]),
        "zeros after the head": valid[:64] + bytes(len(valid) - 64),
    }


def is_refused(run):
    """Whether a command has refused its input with a short reason, within the limits."""
    return run.code in REFUSED and is_bounded(run) and len(run.error) < 2000


def is_bounded(run):
    return run.seconds <= MAX_SECONDS and run.memory <= MAX_MEMORY


def execute(command):
    """Runs a command for at most five times the allowed time."""
    return measured.execute(command, 5 * MAX_SECONDS)


def record_tree(program, server, folder):
    """Records some steps of the tree."""
    with Client(server) as client:
        client.open_scene("tree", timeout=60)
    path = folder / "valid.mcap"
    url = f"http://{server.address}"
    command = [program.with_name("modalcast-record"), "record", "tree", "--server", url, "--out", path, "--steps", "10"]
    with subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as recorder:
        # The line `ready`: later steps are recorded.
        recorder.stdout.readline()
        physics = [program.with_name("modalcast-sim"), "--server", url, "--scene", "tree", "--steps", "10"]
        subprocess.run(physics, check=True, capture_output=True)
        if recorder.wait(60) != 0:
            raise RuntimeError(recorder.stderr.read().decode())
    return path.read_bytes()


def commands(recorder, server, path, out):
    """The ways to use a recording. Its description and its states are read by both."""
    return {
        "export": [recorder, "export", path, "--to", "npz", "--out", out],
        "replay": [recorder, "replay", path, "--server", f"http://{server.address}"],
    }


def run(program):
    recorder = program.with_name("modalcast-record")
    with tempfile.TemporaryDirectory() as name, Server(program) as server:
        folder = Path(name)
        valid = record_tree(program, server, folder)
        path, out = folder / "hostile.mcap", folder / "out"
        accepted, slowest, largest, count = [], 0.0, 0, 0
        for kind, content in hostile_files(valid).items():
            path.write_bytes(content)
            for command, arguments in commands(recorder, server, path, out).items():
                result = execute(arguments)
                count += 1
                slowest, largest = max(slowest, result.seconds), max(largest, result.memory)
                if not is_refused(result):
                    accepted.append(
                        f"{kind} ({command}: code {result.code}, {result.seconds:.1f} s, {mb(result.memory)})"
                    )
            # `recover` copies what precedes the damage, or refuses the file.
            result = execute([recorder, "recover", path, "--out", out])
            count += 1
            slowest, largest = max(slowest, result.seconds), max(largest, result.memory)
            if result.code not in (0, *REFUSED) or not is_bounded(result):
                accepted.append(f"{kind} (recover: code {result.code}, {result.seconds:.1f} s, {mb(result.memory)})")
        with Client(server) as client:
            scenes = client.scenes.ListScenes(scenes_pb2.ListScenesRequest(), timeout=10).scenes
        path.write_bytes(valid)
        control = execute(commands(recorder, server, path, out)["export"])
    passed = not accepted and [scene.scene for scene in scenes] == ["tree"]
    return [
        Result(
            ITEM,
            "hostile recordings are refused, whether they are cut, overlap, claim too much or have wrong schemas",
            f"exit code 3 to 5, within {MAX_SECONDS} s and {mb(MAX_MEMORY)}; no new scene on the server",
            f"{count} commands, at most {slowest:.1f} s and {mb(largest)}"
            + "".join(f"; {entry}" for entry in accepted),
            passed,
            f"the recording before it was changed, exit code {control.code}",
            not is_refused(control),
        )
    ]
