"""Item 3: small files that decode to much memory, and large frames, are rejected before the memory is allocated."""

import contextlib
import io
import struct
import threading
import time
import zipfile
import zlib

import grpc
from client import Client, frames_pb2, upload_files
from report import Result, mb
from server import Peak, Server

ITEM = 3

# Side of the images in pixels: 268 MB each in memory. Uploads of so many of them have 2 MB.
SIDE = 8192
IMAGES = 8

UPLOADS = 4

# Rows of the array of vertices in an archive: 1.9 GB of zeros.
VERTICES = 80_000_000

# Rows of an array of vertices of 144 MB, which is within the limit, and columns of its modes, which have 1 GB.
ARCHIVE_VERTICES = 6_000_000
ARCHIVE_MODES = 7

# Limit on the address space of a server in bytes, and the images of an upload that alone is within it: 537 MB.
ADDRESS_SPACE = 4 << 30
SMALL_IMAGES = 2

# Limit on the memory of all scenes, and on the growth of the server's memory.
LIMIT = 256 << 20
MAX_GROWTH = 96 << 20

OBJ = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"


def png(side):
    """A PNG file of side x side transparent pixels."""
    compressor = zlib.compressobj(9)
    row = bytes(1 + 4 * side)
    data = b"".join(compressor.compress(row) for _ in range(side)) + compressor.flush()

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def model(image, images):
    """The files of a model with so many images of the same content."""
    faces = "".join(f"usemtl m{number}\nf 1/1 2/1 3/1\n" for number in range(images))
    materials = "".join(f"newmtl m{number}\nmap_Kd {number}.png\n" for number in range(images))
    files = {f"{number}.png": image for number in range(images)}
    return {"m.obj": (OBJ + faces).encode(), "m.mtl": materials.encode(), **files}


def write_zeros(archive, name, rows, columns, kind="<f8"):
    """Adds an array of zeros of 8 bytes each to a NumPy archive."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}".ljust(117) + "\n"
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        member.write(b"\x93NUMPY\x01\x00\x76\x00" + header.encode())
        block = bytes(1_000_000)
        whole_blocks, rest = divmod(8 * rows * columns, len(block))
        for _ in range(whole_blocks):
            member.write(block)
        member.write(block[:rest])


def archive(vertices, modes=0):
    """A NumPy archive whose array of vertices has so many rows of zeros, and its modes so many columns."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        write_zeros(archive, "vertices", vertices, 3)
        write_zeros(archive, "faces", 1, 3, "<i8")
        if modes:
            write_zeros(archive, "U", 3 * vertices, modes)
    return {"m.npz": data.getvalue()}


@contextlib.contextmanager
def sampled(peak):
    """Samples a peak until the block ends."""
    is_done = threading.Event()

    def sample():
        while not is_done.wait(0.005):
            peak.sample()

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield
    finally:
        is_done.set()
        thread.join()


def is_out_of_memory(call):
    """Whether a call fails because of the limit on memory."""
    try:
        call()
    except grpc.RpcError as error:
        return error.code() == grpc.StatusCode.RESOURCE_EXHAUSTED and "bytes (" in error.details()
    return False


def attack_with_files(program, limit, uploads):
    """Uploads that are rejected, growth of the memory, and whether another scene is still served."""
    flags = ["--scenes-host-bytes", str(limit), "--scene-host-bytes", str(limit)]
    with Server(program, *flags) as server, Client(server) as client:
        client.open_scene("tree", "tree")
        peak = Peak(server.memory)
        with sampled(peak):
            rejected = sum(
                is_out_of_memory(lambda files=files, number=number: upload_files(client, f"s{number}", files))
                for number, files in enumerate(uploads)
            )
        is_served = server.process.poll() is None and any(info.scene == "tree" for info in client.list_scenes())
        return rejected, peak.growth(), is_served


def attack_within_address_space(program, images, *flags):
    """Concurrent uploads of so many images under a limit on the address space. Returns how many uploads are opened, how
    many are rejected because of the memory, and whether another scene is still served."""
    files = model(png(SIDE), images)
    with Server(program, *flags, address_space=ADDRESS_SPACE) as server, Client(server) as client:
        client.open_scene("tree", "tree")
        opened, rejected = [], []

        def upload(number):
            def send():
                upload_files(client, f"s{number}", files)
                opened.append(number)

            if is_out_of_memory(send):
                rejected.append(number)

        uploads = [threading.Thread(target=upload, args=[number]) for number in range(UPLOADS)]
        for thread in uploads:
            thread.start()
        for thread in uploads:
            thread.join()
        try:
            is_served = any(info.scene == "tree" for info in client.list_scenes())
        except grpc.RpcError:
            is_served = False
        return len(opened), len(rejected), is_served and server.process.poll() is None


def render(client, side):
    picture = frames_pb2.Picture(width=side, height=side, format=frames_pb2.FORMAT_RGBA)
    request = frames_pb2.RenderFrameRequest(scene="tree", pictures=[picture], deadline_ms=600_000)
    for _ in client.frames.RenderFrame(request, timeout=120):
        pass


def attack_with_frames(program, *flags):
    """Whether a large frame is rejected and a small one is drawn, growth of the memory, and seconds."""
    with Server(program, *flags, renderer="software") as server, Client(server) as client:
        client.open_scene("tree", "tree")
        render(client, 256)
        peak, start = Peak(server.memory), time.monotonic()
        with sampled(peak):
            is_rejected = is_out_of_memory(lambda: render(client, SIDE))
        seconds = time.monotonic() - start
        render(client, 256)
        return is_rejected, peak.growth(), seconds


def run(program):
    image = png(SIDE)
    uploads = [model(image, IMAGES)] * UPLOADS + [archive(VERTICES)]
    size = max(sum(map(len, files.values())) for files in uploads)
    rejected, growth, is_served = attack_with_files(program, LIMIT, uploads)
    _, control_growth, _ = attack_with_files(program, 1 << 40, [model(image, 2)])
    with_modes = [archive(ARCHIVE_VERTICES, ARCHIVE_MODES)]
    modes_rejected, modes_growth, modes_served = attack_with_files(program, LIMIT, with_modes)
    _, control_modes_growth, _ = attack_with_files(program, 1 << 40, with_modes)
    opened, limit_rejected, limit_served = attack_within_address_space(program, SMALL_IMAGES)
    *_, control_served = attack_within_address_space(program, IMAGES, "--scenes-host-bytes", str(1 << 40))
    is_rejected, frame_growth, seconds = attack_with_frames(program, "--render-target-bytes", str(LIMIT))
    _, control_frame_growth, _ = attack_with_frames(program)
    return [
        Result(
            ITEM,
            f"{len(uploads)} uploads of at most {size / 1e6:.1f} MB that decode to 1.9 GB or more each",
            f"all rejected with the numbers, another scene served, +{mb(MAX_GROWTH)}",
            f"{rejected} rejected, {'served' if is_served else 'not served'}, +{mb(growth)}",
            rejected == len(uploads) and is_served and growth <= MAX_GROWTH,
            f"two of the images without a limit, +{mb(control_growth)}",
            control_growth > MAX_GROWTH,
        ),
        Result(
            ITEM,
            f"an archive of {len(with_modes[0]['m.npz']) / 1e6:.1f} MB with 144 MB of vertices and 1 GB of modes",
            f"rejected with the numbers before the vertices are read, another scene served, +{mb(MAX_GROWTH)}",
            f"{modes_rejected} rejected, {'served' if modes_served else 'not served'}, +{mb(modes_growth)}",
            modes_rejected == 1 and modes_served and modes_growth <= MAX_GROWTH,
            f"without a limit, +{mb(control_modes_growth)}",
            control_modes_growth > MAX_GROWTH,
        ),
        Result(
            ITEM,
            f"{UPLOADS} uploads of images at once within an address space (ulimit -v) of {mb(ADDRESS_SPACE)}",
            "opened or rejected with the numbers, at least one of each, another scene served",
            f"{opened} opened, {limit_rejected} rejected, {'served' if limit_served else 'not served'}",
            min(opened, limit_rejected) > 0 and opened + limit_rejected == UPLOADS and limit_served,
            f"more images and no limit on scenes, {'served' if control_served else 'the server ended'}",
            not control_served,
        ),
        Result(
            ITEM,
            f"a frame of {SIDE} x {SIDE} pixels above the limit of the render targets",
            f"rejected with the numbers, smaller frames drawn, +{mb(MAX_GROWTH)}",
            f"{'rejected' if is_rejected else 'drawn'} in {seconds:.2f} s, +{mb(frame_growth)}",
            is_rejected and frame_growth <= MAX_GROWTH,
            f"the default limit, +{mb(control_frame_growth)}",
            control_frame_growth > MAX_GROWTH,
        ),
    ]
