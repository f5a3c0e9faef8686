"""An open scene: pictures, vertices, states, picks and forces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._async.describe import read_attachments, read_description, read_modes
from modalcast._async.drive import Drive, DriveOptions
from modalcast._async.streams import FrameBatchStream, FrameStream, Stream, read_reply, with_reconnect
from modalcast._async.transport import ReplyStream, Transport
from modalcast._async.views import ViewBatchStream, Views
from modalcast._channel import deadline_ms
from modalcast._chunks import malformed
from modalcast._common import Delivery, StepId, delivery_message, step_id, step_selector
from modalcast._decoders import (
    ForceDecoder,
    FrameDecoder,
    ReplyDecoder,
    SceneStateDecoder,
    VertexSetDecoder,
    parse,
)
from modalcast._methods import (
    APPLY_FORCES,
    CREATE_VIEWER_LINK,
    GET_STATE,
    GET_VERTICES,
    PICK,
    RENDER_FRAME,
    RESET_SCENE,
    SHARE_SCENE,
    STREAM_FORCES,
    STREAM_FRAMES,
    STREAM_STATES,
    STREAM_VERTICES,
)
from modalcast._types import F32
from modalcast.camera import Camera
from modalcast.forces import Force, ForceSet, Hit, PickResult, force_messages, hit_from_message
from modalcast.frame import ColorFormat, Frame, Outputs, PictureOptions, picture_size
from modalcast.kinematics import Kinematics
from modalcast.scene_description import ArrayName, Domain, Domains, SceneDescription
from modalcast.states import SceneState, StateLayout
from modalcast.step_values import rest_values
from modalcast.v1 import (
    common_pb2,
    forces_pb2,
    frames_pb2,
    scenes_pb2,
    server_pb2,
    states_pb2,
    steps_pb2,
    vertices_pb2,
)
from modalcast.vertices import Attributes, VertexSet, output_bytes, vertex_selection
from modalcast.viewer import ViewerLink, viewer_link
from modalcast.views import (
    StateProgress,
    StateTable,
    ViewArrays,
    ViewCameras,
    ViewOptions,
    ViewOutputs,
    ViewSize,
    batch_size_of,
    device_slots_of,
    report_progress,
    view_options,
)

if TYPE_CHECKING:
    from modalcast._async.client import Client

T = TypeVar("T")


class Scene:
    """An open scene, from `Client.open`, `Client.scene` or `Client.upload`.

    Calls without `step` show the current step; `step` waits for that step or a later one, and `exact` for exactly that
    one. `timeout` is in seconds; None is that of the client.

    Attributes:
        client: The connection, which the scene keeps open.
        info: Size, units, up axis, bounds and origin; `SceneInfo` in `scenes.proto` documents the fields.
        domains: The domains, by index and by name.
    """

    def __init__(
        self,
        client: Client,
        transport: Transport,
        description: SceneDescription,
        force_owner: bytes,
        *,
        timeout: float,
        reconnect: float,
    ) -> None:
        """`Client` creates scenes."""
        self.client = client
        self.info: scenes_pb2.SceneInfo = description.info
        self.domains: Domains = description.domains
        self._transport = transport
        self._force_owner = force_owner
        self._timeout = timeout
        self._reconnect = reconnect
        has_packed_q = server_pb2.FEATURE_PACKED_Q in client.info.features
        origin, unit = self.info.origin, self.info.unit
        self._layout = StateLayout(self.domains, has_packed_q=has_packed_q, scene_origin=origin, unit=unit)
        self._has_rgb = server_pb2.FEATURE_RGB_FRAMES in client.info.features
        self._kinematics: Kinematics | None = None

    @property
    def name(self) -> str:
        """The name of the scene on the server."""
        return self.info.scene

    @property
    def vertex_count(self) -> int:
        """Number of vertices of all domains."""
        return self.info.vertices

    @property
    def coordinate_count(self) -> int:
        """Number of coordinates q of all domains."""
        return self.info.coordinates

    @property
    def owner(self) -> str:
        """The principal that the scene belongs to: "owner" for the user who has started the server."""
        return self.info.owner

    @property
    def shared_with(self) -> tuple[str, ...]:
        """The principals with whom the scene is shared, or `("*",)` for all."""
        return tuple(self.info.shared_with)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Warnings of the loader, for example about missing images and an implausible size. Empty for most scenes."""
        return tuple(self.info.remarks)

    def __repr__(self) -> str:
        counts = f"{len(self.domains)} domains, {self.vertex_count} vertices, {self.coordinate_count} coordinates"
        return f"<Scene '{self.name}': {counts}>"

    async def view(self, *, height: int = 600, timeout: float | None = None) -> ViewerLink:
        """The browser viewer of this scene, which a notebook shows. `ViewerLink.open` opens it in a browser.

        The browser must reach the server at the address of this client. Through SSH, forward the port:
        `ssh -L PORT:127.0.0.1:PORT HOST`.

        Each link is valid once: call `view` again to show the viewer another time.

        Args:
            height: Height in a notebook, in pixels.
            timeout: In seconds; None: that of the client.

        Raises:
            Unavailable: The viewer of the server is off, or the client uses a Unix socket.
            Error: The call failed.
        """
        request = server_pb2.CreateViewerLinkRequest()
        reply = await self._transport.unary(CREATE_VIEWER_LINK, request, self._time_limit(timeout))
        return viewer_link(self.client.address, reply, self.name, height)

    async def describe(
        self,
        arrays: Sequence[ArrayName] = (),
        *,
        domains: Sequence[int | str | Domain] = (),
        textures: bool = False,
        hashes: bool = False,
        cache: str | None = None,
        timeout: float | None = None,
    ) -> SceneDescription:
        """Describes domains, and the shapes, materials and textures that they use.

        Args:
            arrays: Arrays of the shapes to read, see `Shape.arrays`.
            domains: The domains; empty: all.
            textures: Whether to read the pixels of textures.
            hashes: Whether to return the hashes of arrays and textures.
            cache: A folder for arrays and pixels by their SHA-256; a content that is in the folder is not received.
            timeout: In seconds, for each call; None: that of the client.

        Raises:
            KeyError: A domain name is unknown.
            OSError: The folder cannot be written.
            Error: The call failed.
        """
        selected = [self.domains[domain].index for domain in domains]
        time_limit = self._time_limit(timeout)

        async def read() -> SceneDescription:
            return await read_description(
                self._transport,
                self.name,
                selected,
                arrays,
                textures=textures,
                hashes=hashes,
                cache=cache,
                timeout=time_limit,
            )

        return await with_reconnect(self._transport, self._reconnect, read)

    async def modes(
        self, domain: int | str | Domain, vertices: Sequence[int] = (), *, timeout: float | None = None
    ) -> F32:
        """The rows of U of a domain for k vertices, 3k x r. Without `vertices`: for all n vertices.

        Raises:
            KeyError: No domain has the name.
            Error: The call failed.
        """
        index, time_limit = self.domains[domain].index, self._time_limit(timeout)
        return await with_reconnect(
            self._transport,
            self._reconnect,
            lambda: read_modes(self._transport, self.name, index, vertices, time_limit),
        )

    async def drive(
        self,
        *,
        delivery: Delivery = "lossless",
        joints: bool = True,
        reset: bool | None = None,
        take_over: bool = False,
        window: int | None = None,
        stall_budget: float | None = None,
        lease_token: bytes = b"",
        dt: float = 1 / 60,
        timeout: float | None = None,
    ) -> Drive:
        """Becomes the writer of the scene.

        Args:
            delivery: "lossless": every step is computed, in order, and a slow lossless reader slows the drive down.
                "latest": steps that arrive while another one is computed are merged into one.
            joints: Whether to compute the transforms of attached domains, so that they move with their parents.
            reset: True: the first step starts from the rest state. False: from the current state. None: from the rest
                state, unless `lease_token` is that of the last writer.
            take_over: Whether to replace the current writer.
            window: Largest number of steps without acknowledgment; None: the server's limit.
            stall_budget: Seconds for which lossless readers may make the drive wait, up to a day: a budget that is
                refilled by a tenth of the elapsed time. Readers that exceed it end with `LimitReached`. None: the
                server's default of 2 s. With a large budget, a slow reader slows the drive down instead of missing
                steps.
            lease_token: Replaces the writer with this token (`Drive.lease_token`) at once and continues its state.
            dt: Seconds between steps that do not set their time.
            timeout: Default time limit of the calls of the drive, in seconds.

        Raises:
            AlreadyExists: Another writer drives the scene, and `take_over` is false.
            Error: The call failed.
        """
        time_limit = self._time_limit(timeout)
        kinematics = await self._load_kinematics(time_limit) if joints else None
        drive = Drive(
            self._transport,
            self.name,
            self._layout,
            kinematics,
            DriveOptions(delivery, reset, take_over, window, stall_budget, lease_token, dt),
            lambda: self.state(timeout=time_limit),
            timeout=time_limit,
            reconnect=self._reconnect,
        )
        await drive.start()
        return drive

    async def reset(self, *, take_over: bool = False, timeout: float | None = None) -> StepId:
        """Returns to the rest state. A program that drives the scene calls `Drive.reset` instead.

        Raises:
            AlreadyExists: Another writer drives the scene, and `take_over` is false.
            Error: The call failed.
        """
        request = steps_pb2.ResetSceneRequest(scene=self.name, take_over=take_over)
        return step_id((await self._transport.unary(RESET_SCENE, request, self._time_limit(timeout))).step)

    async def frame(
        self,
        camera: Camera | None = None,
        *,
        outputs: Outputs = "color",
        width: int | None = None,
        height: int | None = None,
        format: ColorFormat = "raw",  # noqa: A002 # the usual name
        jpeg_quality: int = 90,
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> Frame:
        """Renders a frame.

        Args:
            camera: `look_at`, `at_pose` or `pinhole`; None shows the whole scene.
            outputs: One or several of "color", "depth", "depth_with_ground", "domains", "normals", "displacement" and
                "mode_shape", or `Output` for parameters. All are of the same step, and each is one array.
            width: In pixels; None: that of the camera, or 1280.
            height: In pixels; None: that of the camera, or 720.
            format: Encoding of color: "raw" for arrays, "png", or "jpeg".
            jpeg_quality: 1 to 100.
            step, exact, timeout: As for the class.

        Raises:
            ValueError: An argument is invalid.
            StepPassed: The scene has passed the exact step.
            Error: The call failed.
        """
        frames = await self.frame_batch(
            [camera],
            outputs=outputs,
            width=width,
            height=height,
            format=format,
            jpeg_quality=jpeg_quality,
            step=step,
            exact=exact,
            timeout=timeout,
        )
        return frames[0]

    async def frame_batch(
        self,
        cameras: Sequence[Camera | None],
        *,
        outputs: Outputs = "color",
        width: int | None = None,
        height: int | None = None,
        format: ColorFormat = "raw",  # noqa: A002
        jpeg_quality: int = 90,
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> list[Frame]:
        """Renders one frame per camera, all of the same step; at most 16 pictures (cameras times outputs).

        Raises:
            Error: As for `frame`, which documents the other arguments.
        """
        options = PictureOptions(cameras, outputs, width, height, format, jpeg_quality, self._has_rgb)
        time_limit = self._time_limit(timeout)
        request = frames_pb2.RenderFrameRequest(
            scene=self.name,
            pictures=options.to_messages(self.info.up),
            step=step_selector(step, exact=exact),
            deadline_ms=deadline_ms(time_limit),
        )
        return await self._read_one(
            lambda: self._transport.stream(RENDER_FRAME, request, time_limit),
            lambda: FrameDecoder(options.names(), len(cameras), chunk_field=1),
        )

    async def frames(
        self,
        camera: Camera | None = None,
        *,
        outputs: Outputs = "color",
        width: int | None = None,
        height: int | None = None,
        format: ColorFormat = "raw",  # noqa: A002
        jpeg_quality: int = 90,
        delivery: Delivery = "latest",
        max_hz: float = 0.0,
        count: int = 0,
    ) -> FrameStream:
        """Iterates over one frame per step. The subscription begins before this returns.

        Args:
            camera: As for `frame`; `FrameStream.move_camera` moves it.
            outputs, width, height, format, jpeg_quality: As for `frame`.
            delivery: "latest": the newest step, beginning with the current one if the scene has had a step. "lossless":
                every step from the next one on; a slow reader slows the drive down.
            max_hz: Limits the frames per second, with the delivery "latest"; 0: no limit.
            count: Ends the stream after this number of frames; 0: no limit.

        Raises:
            ValueError: An argument is invalid.
            Error: The call failed.
        """
        return FrameStream(
            await self.frame_batches(
                [camera],
                outputs=outputs,
                width=width,
                height=height,
                format=format,
                jpeg_quality=jpeg_quality,
                delivery=delivery,
                max_hz=max_hz,
                count=count,
            )
        )

    async def frame_batches(
        self,
        cameras: Sequence[Camera | None],
        *,
        outputs: Outputs = "color",
        width: int | None = None,
        height: int | None = None,
        format: ColorFormat = "raw",  # noqa: A002
        jpeg_quality: int = 90,
        delivery: Delivery = "latest",
        max_hz: float = 0.0,
        count: int = 0,
    ) -> FrameBatchStream:
        """Iterates over one frame per camera and step, as lists.

        Raises:
            Error: As for `frames`, which documents the arguments.
        """
        options = PictureOptions(cameras, outputs, width, height, format, jpeg_quality, self._has_rgb)
        pictures = options.to_messages(self.info.up)
        wire_delivery = delivery_message(delivery)

        def open_call(steps: int, wait: bool) -> ReplyStream:
            request = frames_pb2.StreamFramesRequest(
                scene=self.name, pictures=pictures, delivery=wire_delivery, max_hz=max_hz, steps=steps
            )
            return self._transport.subscribe(STREAM_FRAMES, request, wait_for_ready=wait)

        stream = FrameBatchStream(
            self._transport,
            pictures,
            len(options.names()),
            self.info.up,
            self._timeout,
            open_call,
            lambda: FrameDecoder(options.names(), len(cameras), chunk_field=2),
            count=count,
            reconnect=self._stream_reconnect(delivery),
        )
        await stream.start()
        return stream

    async def views(
        self,
        cameras: ViewCameras | None = None,
        *,
        worlds: int = 1,
        camera_worlds: ArrayLike | None = None,
        size: ViewSize | None = None,
        outputs: ViewOutputs = ("color",),
        device: str | None = None,
        slots: int = 4,
        timeout: float | None = None,
    ) -> Views:
        """Opens copies of the scene (worlds), of which each step draws small pictures (views), for closed loops.

        The worlds begin at rest and belong to this call: nobody else sees them, and the scene and its writer remain as
        they are. A view has one sample per pixel, and no shadows, ambient occlusion or antialiasing. A step has at most
        65,536 views.

        Args:
            cameras: One or several; None: one that frames the rest bounds of a world.
            worlds: Number of worlds, 1 to 65,536.
            camera_worlds: The index of the world of each camera; None: every camera sees every world.
            size: Side of a view or (width, height) in pixels, 1 to 1024; None: that of a pinhole camera, or 64.
            outputs: One or several of "color", "depth" or "depth_with_ground", "domains" and "normals".
            device: None: the pictures are arrays of numpy. "cuda": they are `DeviceArray`s on the GPU of the server, of
                which torch, cupy and jax make tensors without a copy. The server runs on this machine, for this user.
            slots: With a device, the number of steps whose arrays can exist at a time, 2 to 16.
            timeout: Default time limit of the calls of `Views`, in seconds.

        Raises:
            ValueError: An argument is invalid.
            InvalidRequest: The scene has materials or settings that views do not have.
            Unavailable: The server does not draw views, or not in memory of a GPU that this process sees.
            Error: The call failed.
        """
        options = view_options(worlds, cameras, camera_worlds, size, outputs, device_slots_of(device, slots))
        time_limit = self._time_limit(timeout)
        return await with_reconnect(self._transport, self._reconnect, lambda: self._open_views(options, time_limit))

    async def render_states(
        self,
        q: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        *,
        cameras: ViewCameras | None = None,
        size: ViewSize | None = None,
        outputs: ViewOutputs = ("color",),
        joints: bool = True,
        batch_size: int | None = None,
        out: Mapping[str, NDArray[Any]] | None = None,
        progress: bool | StateProgress = False,
        timeout: float | None = None,
    ) -> ViewArrays:
        """Draws small pictures of any number of states, as `views` does. The scene and its writer remain as they are.

        Args:
            q: All coordinates of N states, N x r, in the order of `SceneState.q`; None: at rest.
            transforms: world_from_domain of N states: N x R x 3 x 4 for the R domains that follow no other one, in the
                order of `domains`, or N x 3 x 4 if R is 1; or 4 x 4 in place of 3 x 4. Translations are in scene units
                relative to the scene's origin. None: at rest.
            cameras: C cameras, which see every state; None: one that frames the rest bounds of the scene.
            size: Side of a picture or (width, height) in pixels, 1 to 1024; None: that of a pinhole camera, or 64.
            outputs: One or several of "color", "depth" or "depth_with_ground", "domains" and "normals".
            joints: Whether to compute the transforms of attached domains, so that they move with their parents. Those
                in `transforms` are then ignored.
            batch_size: Number of states that the server draws at a time; None: as many as are efficient.
            out: Arrays that receive the pictures, by output, such as `numpy.memmap`: writable and C-contiguous, of the
                shapes and types below.
            progress: True: a progress bar of tqdm, if it is installed; or a function that is called with the number of
                states that are drawn and N.
            timeout: Seconds without a reply of the server after which the call fails; None: that of the client.

        Returns:
            By output, in the order of the states: color N x C x H x W x 3 of uint8, sRGB; depth N x C x H x W of
            float32, meters along the view axis, infinity where nothing is; domains N x C x H x W of int32, the index of
            the domain, -1 where none is; normals N x C x H x W x 3 of float32, unit vectors in world axes, zeros where
            nothing is. `numpy.moveaxis(color, -1, 2)` has the channels first. With `out`, these are its arrays.

        Raises:
            ValueError: An array has another shape or type, or a number is not finite.
            ImportError: `progress` is True, and tqdm is not installed.
            Error: As for `views`.
        """
        states, options = await self._states(q, transforms, cameras, size, outputs, joints, batch_size, timeout)
        leading = states.count, options.camera_count
        arrays = options.format.arrays(leading, out)
        with report_progress(progress, states.count) as report:
            stream = await self._batches(states, options, arrays, timeout)
            async with stream:
                async for drawn, _ in stream:
                    report(drawn.stop)
        return arrays

    async def iter_states(
        self,
        q: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        *,
        cameras: ViewCameras | None = None,
        size: ViewSize | None = None,
        outputs: ViewOutputs = ("color",),
        joints: bool = True,
        batch_size: int | None = None,
        timeout: float | None = None,
    ) -> ViewBatchStream:
        """Draws small pictures of any number of states, batch by batch, in bounded memory.

        Each item is a slice of the states, and the dict that `render_states` would return for them. Its arrays are new.
        `q` and `transforms` must not change during the iteration.

        Args:
            q, transforms, cameras, size, outputs, joints, timeout: As for `render_states`.
            batch_size: Number of states of a batch; None: as many as are efficient.

        Raises:
            Error: As for `render_states`.
        """
        states, options = await self._states(q, transforms, cameras, size, outputs, joints, batch_size, timeout)
        return await self._batches(states, options, None, timeout)

    async def joint_transforms(
        self, q: ArrayLike, transforms: ArrayLike | None = None, *, timeout: float | None = None
    ) -> F32:
        """The transforms with which attached domains move with their parents, for `Views.step`.

        Args:
            q: All coordinates of N states, N x r.
            transforms: world_from_domain of N states, as for `render_states`; those of attached domains are ignored.
                None: at rest.
            timeout: In seconds; None: that of the client.

        Returns:
            N x R x 3 x 4 for the R domains that follow no other one.

        Raises:
            ValueError: An array has another shape, or a number is not finite.
            Error: The call failed.
        """
        states = StateTable(self._layout, q, transforms)
        states.kinematics = await self._load_kinematics(self._time_limit(timeout))
        matrices = states.batch(0, states.count, states.count)[1]
        if matrices is None:
            placements = rest_values(self._layout)[1][self._layout.roots].astype(np.float32)
            matrices = np.tile(placements, (states.count, 1, 1, 1))
        return matrices

    async def vertices(
        self,
        out: F32 | None = None,
        *,
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> F32:
        """Positions of all vertices: n x 3, domain by domain, in scene units relative to the scene's origin.

        Args:
            out: An n x 3 array of float32 that receives the positions, and is returned.
            step, exact, timeout: As for the class.

        Raises:
            ValueError: `out` has another shape or type.
            Error: The call failed.
        """
        target = None if out is None else output_bytes(out, self.vertex_count)
        selection = vertex_selection(self.domains, (), ("positions",))
        vertex_set = await self._vertex_set(
            selection, lambda: VertexSetDecoder(1, 2, target), step, exact=exact, timeout=timeout
        )
        if vertex_set.positions is None:
            raise malformed("vertices.sections", "positions", "none")
        return vertex_set.positions if out is None else out

    async def vertex_set(
        self,
        attributes: Attributes = ("positions", "normals"),
        *,
        domains: Sequence[int | str | Domain] = (),
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> VertexSet:
        """Reads attributes of the vertices of a step.

        Args:
            attributes: One or several of "positions", "normals", "displacements" and "boxes", or a mapping from these
                to encodings: "f32", "f16", "u16_box" (positions, displacements) or "octahedral_i16" (normals). The
                returned arrays are f32.
            domains: The domains, in the order of the arrays; empty: all.
            step, exact, timeout: As for the class.

        Raises:
            KeyError: A domain name is unknown.
            ValueError: An attribute or an encoding is unknown.
            Error: The call failed.
        """
        selection = vertex_selection(self.domains, domains, attributes)
        return await self._vertex_set(selection, lambda: VertexSetDecoder(1, 2), step, exact=exact, timeout=timeout)

    async def vertex_sets(
        self,
        attributes: Attributes = ("positions",),
        *,
        domains: Sequence[int | str | Domain] = (),
        delivery: Delivery = "latest",
        max_hz: float = 0.0,
        count: int = 0,
    ) -> Stream[VertexSet]:
        """Iterates over the vertices of steps; `vertex_set` and `frames` document the arguments.

        Raises:
            KeyError: A domain name is unknown.
            ValueError: An argument is invalid.
            Error: The call failed.
        """
        selection = vertex_selection(self.domains, domains, attributes)
        wire_delivery = delivery_message(delivery)

        def open_call(steps: int, wait: bool) -> ReplyStream:
            request = vertices_pb2.StreamVerticesRequest(
                scene=self.name, selection=selection, delivery=wire_delivery, max_hz=max_hz, steps=steps
            )
            return self._transport.subscribe(STREAM_VERTICES, request, wait_for_ready=wait)

        return await self._start(open_call, lambda: VertexSetDecoder(2, 3), count, delivery)

    async def state(
        self, *, step: StepId | int | None = None, exact: bool = False, timeout: float | None = None
    ) -> SceneState:
        """Reads the coordinates q and the transforms T of all domains.

        Raises:
            Error: The call failed.
        """
        time_limit = self._time_limit(timeout)
        request = states_pb2.GetStateRequest(
            scene=self.name, step=step_selector(step, exact=exact), deadline_ms=deadline_ms(time_limit)
        )
        return await self._read_one(
            lambda: self._transport.stream(GET_STATE, request, time_limit),
            lambda: SceneStateDecoder(self._layout, chunk_field=1),
        )

    async def steps(
        self, *, delivery: Delivery = "latest", max_hz: float = 0.0, count: int = 0, stages_every: int = 0
    ) -> Stream[SceneState]:
        """Iterates over the coordinates and transforms of steps. Only changes are sent, and complete states returned.

        Args:
            delivery, max_hz, count: As for `frames`.
            stages_every: The first state and every n-th one after it has `SceneState.stages`; 0: no state.

        Raises:
            ValueError: An argument is invalid.
            Error: The call failed.
        """
        wire_delivery = delivery_message(delivery)

        def open_call(steps: int, wait: bool) -> ReplyStream:
            request = states_pb2.StreamStatesRequest(
                scene=self.name, delivery=wire_delivery, max_hz=max_hz, steps=steps, stages_every=stages_every
            )
            return self._transport.subscribe(STREAM_STATES, request, wait_for_ready=wait)

        return await self._start(open_call, lambda: SceneStateDecoder(self._layout, chunk_field=2), count, delivery)

    async def pick(
        self,
        x: int,
        y: int,
        camera: Camera | None = None,
        *,
        width: int | None = None,
        height: int | None = None,
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> Hit | None:
        """The surface at the center of a pixel; None where there is none.

        Args:
            x: Column of the pixel, from the left of the picture.
            y: Row of the pixel, from the top.
            camera: The camera of the picture; None: one that shows the whole scene.
            width: Width of the picture; None: that of the camera, or 1280.
            height: Height of the picture; None: that of the camera, or 720.
            step, exact, timeout: As for the class.

        Raises:
            InvalidRequest: The pixel is outside the picture.
            Error: The call failed.
        """
        picked = await self.pick_rectangle(
            x, y, (1, 1), camera, width=width, height=height, step=step, exact=exact, timeout=timeout
        )
        return picked.hits[0] if picked.hits else None

    async def pick_rectangle(
        self,
        x: int,
        y: int,
        size: tuple[int, int],
        camera: Camera | None = None,
        *,
        modes: bool = True,
        width: int | None = None,
        height: int | None = None,
        step: StepId | int | None = None,
        exact: bool = False,
        timeout: float | None = None,
    ) -> PickResult:
        """The surface at the centers of the pixels of a rectangle.

        Args:
            x: Column of the top left pixel.
            y: Row of the top left pixel.
            size: Width and height of the rectangle in pixels, 1 to 64 each.
            camera: As for `pick`.
            modes: Whether to read `Hit.modes`.
            width, height, step, exact, timeout: As for `pick`.

        Raises:
            ValueError: A pixel or a size is negative.
            InvalidRequest: The rectangle is outside the picture.
            Error: The call failed.
        """
        if min(x, y, *size) < 0:
            raise ValueError(f"expected pixels and sizes of at least 0, got pixel ({x}, {y}) and size {size}")
        picture_width, picture_height = picture_size(camera, width, height)
        picture = frames_pb2.Picture(width=picture_width, height=picture_height)
        if camera is not None:
            picture.camera.CopyFrom(camera.to_message(self.info.up))
        time_limit = self._time_limit(timeout)
        request = frames_pb2.PickRequest(
            scene=self.name,
            picture=picture,
            step=step_selector(step, exact=exact),
            deadline_ms=deadline_ms(time_limit),
            x=x,
            y=y,
            width=size[0],
            height=size[1],
            without_modes=not modes,
        )

        async def read() -> PickResult:
            stream = self._transport.stream(PICK, request, time_limit)
            step_message: common_pb2.StepId | None = None
            hits: list[Hit] = []
            while (message := await stream.read()) is not None:
                reply = parse("pick", frames_pb2.PickResponse, message)
                step_message = reply.head.step if reply.HasField("head") else step_message
                hits.extend(hit_from_message(hit) for hit in reply.hits)
            if step_message is None:
                raise malformed("pick.head", "a head", "none")
            return PickResult(step_id(step_message), tuple(hits))

        return await with_reconnect(self._transport, self._reconnect, read)

    async def apply_forces(
        self, forces: Sequence[Force], *, lifetime: float = 0.5, timeout: float | None = None
    ) -> int:
        """Replaces all forces that this client applies to the scene. An empty list removes them.

        Args:
            forces: `Hit.force`, `surface_force` or `modal_force`; at most 16.
            lifetime: Seconds after which the forces expire unless they are applied again, at most 10.
            timeout: In seconds; None: that of the client.

        Returns:
            The number of this client in `ForceSet.forces`; 0 without forces.

        Raises:
            KeyError: A domain name is unknown.
            ValueError: A modal force does not have one number per mode.
            Error: The call failed.
        """
        request = forces_pb2.ApplyForcesRequest(
            scene=self.name,
            owner=self._force_owner,
            forces=force_messages(self.domains, forces),
            lifetime_ms=max(round(lifetime * 1000), 1),
        )
        reply = await self._transport.unary(APPLY_FORCES, request, self._time_limit(timeout))
        return reply.owner

    async def forces(self, *, max_hz: float = 0.0) -> Stream[ForceSet]:
        """Iterates over the forces of all viewers: the current ones, then all forces after every change.

        Args:
            max_hz: Limits the replies per second; 0: no limit.

        Raises:
            Error: The call failed.
        """
        request = forces_pb2.StreamForcesRequest(scene=self.name, max_hz=max_hz)
        return await self._start(
            lambda _, wait: self._transport.subscribe(STREAM_FORCES, request, wait_for_ready=wait),
            ForceDecoder,
            0,
            "latest",
        )

    async def share(self, *principals: str, timeout: float | None = None) -> None:
        """Shares the scene with other principals of the server, in place of those with whom it was shared.

        Others than its owner do not see a scene that is not shared. Those with whom it is shared may do what their
        roles permit, except delete, reset and share the scene, replace its writer, and receive lossless streams.

        Args:
            principals: Names of principals, or "*" for all. Without names, the scene is no longer shared, and the
                streams of others end.

        Raises:
            PermissionDenied: The scene belongs to another principal.
            InvalidRequest: A name is malformed.
            Error: The call failed.
        """
        request = scenes_pb2.ShareSceneRequest(scene=self.name, principals=principals)
        reply = await self._transport.unary(SHARE_SCENE, request, self._time_limit(timeout))
        self.info.shared_with[:] = reply.shared_with

    async def delete(self, *, timeout: float | None = None) -> None:
        """Closes the scene for all clients, and removes the files of an uploaded scene.

        Raises:
            Error: The call failed.
        """
        await self.client.delete(self.name, timeout=timeout)

    def _time_limit(self, timeout: float | None) -> float:
        if timeout is not None and timeout <= 0:
            raise ValueError(f"timeout: expected a number of seconds above 0, got {timeout}")
        return self._timeout if timeout is None else timeout

    def _stream_reconnect(self, delivery: Delivery) -> float:
        return self._reconnect if delivery == "latest" else 0.0

    async def _start(
        self,
        open_call: Callable[[int, bool], ReplyStream],
        new_decoder: Callable[[], ReplyDecoder[T]],
        count: int,
        delivery: Delivery,
    ) -> Stream[T]:
        reconnect = self._stream_reconnect(delivery)
        stream = Stream(open_call, new_decoder, transport=self._transport, count=count, reconnect=reconnect)
        await stream.start()
        return stream

    async def _read_one(self, open_call: Callable[[], ReplyStream], new_decoder: Callable[[], ReplyDecoder[T]]) -> T:
        """The single reply of a call."""

        async def read() -> T:
            stream = open_call()
            try:
                reply = await read_reply(stream, new_decoder())
                if reply is None:
                    raise malformed("reply", "a complete reply", "the end of the stream")
                # The status after the reply ends the call.
                await stream.read()
            except BaseException:
                stream.cancel()
                raise
            return reply

        return await with_reconnect(self._transport, self._reconnect, read)

    async def _vertex_set(
        self,
        selection: vertices_pb2.VertexSelection,
        new_decoder: Callable[[], VertexSetDecoder],
        step: StepId | int | None,
        *,
        exact: bool,
        timeout: float | None,
    ) -> VertexSet:
        time_limit = self._time_limit(timeout)
        request = vertices_pb2.GetVerticesRequest(
            scene=self.name,
            selection=selection,
            step=step_selector(step, exact=exact),
            deadline_ms=deadline_ms(time_limit),
        )
        return await self._read_one(lambda: self._transport.stream(GET_VERTICES, request, time_limit), new_decoder)

    async def _open_views(self, options: ViewOptions, timeout: float) -> Views:
        views = Views(self._transport, self.name, self.info.up, self._layout, options, timeout=timeout)
        await views.start()
        return views

    async def _states(
        self,
        q: ArrayLike | None,
        transforms: ArrayLike | None,
        cameras: ViewCameras | None,
        size: ViewSize | None,
        outputs: ViewOutputs,
        joints: bool,
        batch_size: int | None,
        timeout: float | None,
    ) -> tuple[StateTable, ViewOptions]:
        """Checks the arguments of `render_states`. The options have one world for each state of a batch."""
        options = view_options(1, cameras, None, size, outputs)
        states = StateTable(self._layout, q, transforms)
        if joints and states.count > 0:
            states.kinematics = await self._load_kinematics(self._time_limit(timeout))
        worlds = batch_size_of(states, options, self.client.info.limits.message_bytes, batch_size)
        return states, replace(options, worlds=worlds)

    async def _batches(
        self, states: StateTable, options: ViewOptions, out: ViewArrays | None, timeout: float | None
    ) -> ViewBatchStream:
        time_limit = self._time_limit(timeout)
        stream = ViewBatchStream(
            self._transport,
            lambda: self._open_views(options, time_limit),
            states,
            options,
            out,
            reconnect=self._reconnect,
        )
        await stream.start()
        return stream

    async def _load_kinematics(self, timeout: float) -> Kinematics | None:
        """Reads the modes near the joints, once. None for a scene without attached domains."""
        if self._kinematics is None and any(domain.parent is not None for domain in self.domains):
            points = await read_attachments(self._transport, self.name, self._layout, timeout)
            self._kinematics = Kinematics(self._layout, points)
        return self._kinematics


async def open_scene(
    client: Client,
    transport: Transport,
    info: scenes_pb2.SceneInfo,
    force_owner: bytes,
    *,
    timeout: float,
    reconnect: float,
) -> Scene:
    """Describes an open scene."""
    description = await read_description(
        transport, info.scene, (), (), textures=False, hashes=False, cache=None, timeout=timeout
    )
    return Scene(client, transport, description, force_owner, timeout=timeout, reconnect=reconnect)
