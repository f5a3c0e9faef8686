"""Item 14: forces that are not finite are refused, and enormous ones do not stop the physics process."""

import contextlib
import math
import struct
import subprocess
import time

import grpc
from client import Client, forces_pb2, forces_pb2_grpc, scenes_pb2
from report import Result, mb
from server import Peak, Server

ITEM = 14

# The largest force in newtons that the server accepts, as `forces.proto` states it.
MAX_NEWTONS = 1e30

# Calls that are refused, and the growth of the memory in bytes that they may cause.
REFUSED_CALLS = 2000
MAX_MEMORY = 16 << 20

# Seconds with the largest forces, and the steps that the physics process sends in that time at least.
SECONDS = 10
MIN_STEPS = 60


def surface(vector, barycentric=(0.25, 0.25, 0.5)):
    return forces_pb2.Force(
        id=1, domain=0, surface=forces_pb2.SurfaceForce(triangle=0, barycentric=barycentric, vector=vector)
    )


def modal(numbers):
    f_q = struct.pack(f"<{len(numbers)}f", *numbers)
    return forces_pb2.Force(id=1, domain=0, modal=forces_pb2.ModalForce(f_q=f_q))


class Viewer:
    """A client that applies forces to the tree."""

    def __init__(self, server):
        self.client = Client(server)
        self.forces = forces_pb2_grpc.ForceServiceStub(self.client.channel)

    def apply(self, forces):
        """Applies forces. Returns the status code and the message."""
        request = forces_pb2.ApplyForcesRequest(scene="tree", owner=b"0123456789abcdef", forces=forces)
        try:
            self.forces.ApplyForces(request, timeout=10)
            return grpc.StatusCode.OK, ""
        except grpc.RpcError as error:
            return error.code(), error.details()

    def step(self):
        """The number of the last step."""
        scenes = self.client.scenes.ListScenes(scenes_pb2.ListScenesRequest(), timeout=10).scenes
        return next(scene.last_step.number for scene in scenes if scene.scene == "tree")

    def received(self):
        """Whether the newest forces of the channel are finite, and the largest number."""
        stream = self.forces.StreamForces(forces_pb2.StreamForcesRequest(scene="tree", passive=True), timeout=10)
        forces = next(iter(stream)).forces
        stream.cancel()
        numbers = [number for force in forces for (number,) in struct.iter_unpack("<f", force.f_q)]
        return all(map(math.isfinite, numbers)), max(map(abs, numbers), default=0.0)

    def rank(self):
        request = scenes_pb2.DescribeSceneRequest(scene="tree")
        for response in self.client.scenes.DescribeScene(request, timeout=30):
            if response.HasField("shapes"):
                return response.shapes.shapes[0].rank
        raise RuntimeError("expected a shape")


def refused(viewer, server):
    """Invalid forces, one call each and again many times."""
    rank = viewer.rank()
    invalid = [surface([bad, 0, 0]) for bad in (math.nan, math.inf, -math.inf, 1.01 * MAX_NEWTONS, 1e300)]
    invalid += [surface([1, 0, 0], (math.nan, 0.5, 0.5)), surface([1, 0, 0], (1e300, -1e300, 1.0)), surface([1, 0])]
    invalid += [modal([bad] + [0.0] * (rank - 1)) for bad in (math.nan, math.inf)] + [modal([1.0] * (rank + 1))]
    answers = [viewer.apply([force]) for force in invalid]
    viewer.received()
    memory = Peak(server.memory)
    for index in range(REFUSED_CALLS):
        viewer.apply([invalid[index % len(invalid)]])
    is_named = all(code == grpc.StatusCode.INVALID_ARGUMENT and "forces[0]" in text for code, text in answers)
    growth = memory.growth()
    control, _ = viewer.apply([surface([1, 2, 3])])
    return Result(
        ITEM,
        "forces that are not finite or too large are refused with their field",
        f"INVALID_ARGUMENT for {len(invalid)} kinds, memory +{mb(MAX_MEMORY)} after {REFUSED_CALLS} calls",
        f"{sum(code == grpc.StatusCode.INVALID_ARGUMENT for code, _ in answers)} refused, +{mb(growth)}",
        is_named and growth <= MAX_MEMORY,
        f"a force of 4 N: {control.name}",
        control == grpc.StatusCode.OK,
    )


@contextlib.contextmanager
def physics(program, server):
    """A physics process that applies the forces of viewers to the tree in calm air."""
    command = [program.parent / "modalcast-sim", "--server", f"http://{server.address}", "--scene", "tree"]
    command += ["--seconds", "0", "--realtime", "--forces", "--wind", "0"]
    process = subprocess.Popen([str(part) for part in command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def steps_under_forces(viewer, newtons):
    """Pulls with alternating directions. Returns the steps in that time, whether all forces on the channel are finite,
    and the largest."""
    first, end, sign, is_finite, largest = viewer.step(), time.monotonic() + SECONDS, 1, True, 0.0
    while time.monotonic() < end:
        sign = -sign
        code, text = viewer.apply([surface([sign * newtons] * 3)])
        if code != grpc.StatusCode.OK:
            raise RuntimeError(text)
        now_finite, now_largest = viewer.received()
        is_finite, largest = is_finite and now_finite, max(largest, now_largest)
        time.sleep(0.2)
    return viewer.step() - first, is_finite, largest


def enormous(program, viewer, server):
    with physics(program, server) as process:
        deadline = time.monotonic() + 60
        first = viewer.step()
        while viewer.step() < first + 5 and time.monotonic() < deadline:
            time.sleep(0.1)
        steps, is_finite, largest = steps_under_forces(viewer, MAX_NEWTONS)
        is_running = process.poll() is None
        process.kill()
        process.wait()
        control, _, _ = steps_under_forces(viewer, 1.0)
    return Result(
        ITEM,
        f"forces of {MAX_NEWTONS:.0e} N neither stop the physics process nor become infinite",
        f"{MIN_STEPS} steps in {SECONDS} s, finite numbers on the channel; the process runs",
        f"{steps} steps, largest number {largest:.1e}, the process {'runs' if is_running else 'has ended'}",
        steps >= MIN_STEPS and is_finite and is_running,
        f"without the process {control} steps",
        control < MIN_STEPS,
    )


def run(program):
    with Server(program) as server:
        viewer = Viewer(server)
        viewer.client.open_scene("tree", timeout=60)
        return [refused(viewer, server), enormous(program, viewer, server)]
