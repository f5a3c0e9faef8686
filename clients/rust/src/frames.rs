//! Frame requests and streams: each reply is a complete frame with its step and stage times.

use std::fmt;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use v1::frame_service_client::FrameServiceClient;
use v1::stream_frames_response::Part as StreamPart;

use crate::assemble::{Chunk, ChunkDecoder, DecodedReplies, WireChunk};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};
use crate::request::{StepRequest, Subscription};
use crate::shared_memory::CallMemory;
use crate::stages::{self, StageTimes};

/// A request for one frame.
pub type FrameRequest = StepRequest<Picture>;

/// A request for the frames of several pictures of one step.
pub type FramesRequest = StepRequest<Pictures>;

/// A subscription to one frame per step and picture.
pub type FrameStreamRequest = Subscription<Pictures>;

/// Encoding of the bytes of a frame, top row first: 8-bit sRGB (`Png`, `Jpeg`, `Rgba`), or numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum FrameFormat {
    #[default]
    Png,
    /// Without alpha; see [`Picture::jpeg_quality`].
    Jpeg,
    /// Three bytes per pixel, if the server has [`Feature::RgbFrames`](crate::Feature::RgbFrames).
    Rgb,
    Rgba,
    /// Little-endian f32, one per pixel: the only format of [`Output::Depth`] and
    /// [`Output::DepthWithGround`].
    F32,
    /// Little-endian u32, one per pixel: the only format of [`Output::Domains`].
    U32,
    /// Little-endian f32, three per pixel: the only format of [`Output::Normals`].
    F32x3,
}

impl FrameFormat {
    /// The extension of a file with such a frame.
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Png => "png",
            Self::Jpeg => "jpg",
            Self::Rgb => "rgb",
            Self::Rgba => "rgba",
            Self::F32 => "f32",
            Self::U32 => "u32",
            Self::F32x3 => "f32x3",
        }
    }
}

/// The quantity that a picture shows; `frames.proto` defines each in detail.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Output {
    #[default]
    Color,
    /// Meters along the view axis; infinity in the background.
    Depth,
    /// As `Depth`, with the depth of the ground in the background.
    DepthWithGround,
    /// Index of the domain; `u32::MAX` in the background.
    Domains,
    /// Unit normals; zeros in the background.
    Normals,
    /// The length of the displacement u = U q as a color map with a legend. `scale_max` is the value at the bright end
    /// in meters; 0 fits the color map to each frame.
    Displacement { scale_max: f64 },
    /// The norm of each vertex's three entries in column `mode` of U, as a color map with a legend. `scale_max` is as
    /// for `Displacement`, but in meters per unit of q.
    ModeShape { mode: u32, scale_max: f64 },
}

/// The pose of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    LookAt {
        eye: [f64; 3],
        target: [f64; 3],
        /// `None`: the up axis of the scene.
        up: Option<[f64; 3]>,
    },
    /// `world_from_camera`, row-major 3x4; x right, y up, looking along -z.
    Pose([f64; 12]),
}

/// The projection of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// Vertical field of view in degrees.
    FieldOfView(f64),
    /// Pinhole model in pixels; (0, 0) is the top left corner.
    Intrinsics { fx: f64, fy: f64, cx: f64, cy: f64 },
}

/// A camera. `clip` is the pair of near and far distance in scene units. With `None`, the server chooses distances that
/// clip nothing in front of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    pub view: View,
    pub lens: Lens,
    pub clip: Option<(f64, f64)>,
}

/// Size, format, camera and output of a picture. Without a camera, the whole scene is visible. 0 x 0 means 1280 x 720.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Picture {
    pub width: u32,
    pub height: u32,
    pub format: FrameFormat,
    pub camera: Option<Camera>,
    pub output: Output,
    /// For [`FrameFormat::Jpeg`]: 1 (smallest frame) to 100 (smallest error); 0 means 90.
    pub jpeg_quality: u32,
    /// For [`Output::Color`]: width in pixels of lines along the edges of the faces, at most 32; 0 for none. `None`: as
    /// the scene's `look.edges`.
    pub edge_width: Option<f32>,
    /// For [`Output::Color`]: samples per pixel, 1 or 4. 0: as the scene sets them; without a setting, a single frame
    /// has 4, and the server chooses for a stream ([`FrameLook::samples`]).
    pub samples: u32,
}

impl Picture {
    /// Sets the size in pixels.
    #[must_use]
    pub const fn size(mut self, width: u32, height: u32) -> Self {
        (self.width, self.height) = (width, height);
        self
    }

    /// Sets the width in pixels of lines along the edges of the faces; 0 for none.
    #[must_use]
    pub const fn edge_width(mut self, pixels: f32) -> Self {
        self.edge_width = Some(pixels);
        self
    }

    /// Sets the samples per pixel, 1 or 4; 0 for the default.
    #[must_use]
    pub const fn samples(mut self, samples: u32) -> Self {
        self.samples = samples;
        self
    }

    /// Sets the encoding.
    #[must_use]
    pub const fn format(mut self, format: FrameFormat) -> Self {
        self.format = format;
        self
    }
}

/// The pictures of a request, 1 to 16. A single picture converts to a list of one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pictures(pub Vec<Picture>);

impl From<Picture> for Pictures {
    fn from(picture: Picture) -> Self {
        Self(vec![picture])
    }
}

impl From<Vec<Picture>> for Pictures {
    fn from(pictures: Vec<Picture>) -> Self {
        Self(pictures)
    }
}

/// One frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The step that the frame shows.
    pub step: v1::StepId,
    /// Index of the frame's picture in the request.
    pub picture: usize,
    /// Number of camera updates of the stream that the frame includes; 0 for a single request.
    pub camera_version: u64,
    pub width: u32,
    pub height: u32,
    pub format: FrameFormat,
    /// A PNG or JPEG file, or 4 or 12 bytes per pixel, as `format` states.
    pub bytes: Bytes,
    /// Number of steps skipped since the previous step of the stream; 0 for all pictures of a step but the first.
    pub skipped: u64,
    pub stages: StageTimes,
    /// The rasterizer of the shadow map. `None` for other outputs than color, and if the map is shared with another
    /// frame of the step.
    pub shadow_drawn_by: Option<DrawnBy>,
    /// The rasterizer of the visible triangles. `None` for other outputs than color.
    pub visibility_drawn_by: Option<DrawnBy>,
    /// Antialiasing and shadow map. `None` for other outputs than color, and from servers that do not report them.
    pub look: Option<FrameLook>,
    /// How far the lowest vertex lies below the ground, in meters; 0 if none does, and for other outputs than color.
    pub below_ground: f64,
    /// Whether a picture without a camera of its own frames the domains where they are, because none of them is in the
    /// view that frames the rest bounds.
    pub reframed: bool,
}

/// Antialiasing and shadow map of a frame, chosen by the scene's settings or by the server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameLook {
    /// The preset that the scene names: `preview`, `standard` or `best`; empty if it names none.
    pub preset: &'static str,
    /// `samples`, `fxaa` or `none`; empty if this client does not know the method.
    pub antialiasing: &'static str,
    /// Samples per pixel.
    pub samples: u32,
    /// `variance`, `standard` or `filtered`; empty without a shadow map.
    pub shadow_method: &'static str,
    /// Side of the shadow map in texels; 0 without a shadow map.
    pub shadow_size: u32,
}

impl fmt::Display for FrameLook {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { preset, antialiasing, samples, shadow_method, shadow_size } = self;
        let preset = if preset.is_empty() { "no preset" } else { preset };
        write!(formatter, "{preset}, antialiasing {antialiasing}, {samples} per pixel, ")?;
        match shadow_size {
            0 => formatter.write_str("no shadow map"),
            size => write!(formatter, "{shadow_method} shadow map {size} x {size}"),
        }
    }
}

/// The rasterizer of a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DrawnBy {
    OpenGl,
    Cuda,
}

impl Client {
    /// Renders one frame.
    ///
    /// # Errors
    /// `Status` if the scene or the step does not exist or the deadline passed; `Malformed` if the reply contradicts
    /// itself; `Connect` if the connection is lost.
    pub async fn render_frame(&self, request: &FrameRequest) -> Result<Frame> {
        let StepRequest { scene, query, step, deadline_ms } = request;
        let frames_request =
            FramesRequest { scene: scene.clone(), query: (*query).into(), step: *step, deadline_ms: *deadline_ms };
        let mut frames = self.render_frames(&frames_request).await?;
        frames.pop().ok_or(Error::StreamEnded { awaited_reply: "the frame" })
    }

    /// Renders one frame per picture, all of the same step, and returns them in the order of the pictures.
    ///
    /// # Errors
    /// As for [`Self::render_frame`].
    pub async fn render_frames(&self, request: &FramesRequest) -> Result<Vec<Frame>> {
        let wire = v1::RenderFrameRequest {
            scene: request.scene.clone(),
            pictures: request.query.to_wire(),
            step: request.step.to_wire(),
            deadline_ms: request.deadline_ms,
        };
        let memory = self.call_memory().await?;
        let reply = FrameServiceClient::new(self.undecoded_channel()).render_frame(memory.request(wire)).await;
        let decoder = ChunkDecoder::new(single_chunk, self.max_reply_bytes, memory);
        let mut replies = DecodedReplies::new(self.replies(reply)?, decoder);
        let mut frames = Vec::new();
        while let Some(frame) = replies.next().await {
            frames.push(frame?);
        }
        let expected_count = request.query.0.len().max(1);
        if frames.len() == expected_count {
            Ok(frames)
        } else {
            Err(Error::StreamEnded { awaited_reply: "all frames" })
        }
    }

    /// Subscribes to frames. When this returns, the server has accepted the subscription: the client receives every
    /// later step if the delivery is lossless.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Connect` if the connection is lost.
    pub async fn stream_frames(&self, request: &FrameStreamRequest) -> Result<FrameStream> {
        let wire = v1::StreamFramesRequest {
            scene: request.scene.clone(),
            pictures: request.query.to_wire(),
            delivery: v1::Delivery::from(request.delivery).into(),
            steps: request.max_steps,
            max_hz: request.max_hz,
        };
        let channel = self.channel_for(request.delivery);
        let memory = self.call_memory().await?;
        let reply = FrameServiceClient::new(channel).stream_frames(memory.request(wire)).await;
        let mut messages = self.replies(reply)?;
        let settings = match messages.next().await?.and_then(|message| message.part) {
            Some(StreamPart::Settings(settings)) => settings,
            part => return Err(malformed_reply("frame.part", "the settings of the stream", format!("{part:?}"))),
        };
        let frames = DecodedReplies::new(messages, ChunkDecoder::new(stream_chunk, self.max_reply_bytes, memory));
        Ok(FrameStream { settings, frames })
    }

    /// Moves cameras of a running stream, each given by the index of its picture; `None` selects a camera that shows
    /// the whole scene. `stream` is the id in [`FrameStream::settings`]. Returns the [`Frame::camera_version`] from
    /// which on frames show the update. If the scene is static, the stream sends its current step again.
    ///
    /// # Errors
    /// `Status` if the stream has ended or a camera is invalid; `Connect` if the connection is lost.
    pub async fn update_frame_stream(&self, stream: &[u8], cameras: &[(u32, Option<Camera>)]) -> Result<u64> {
        let to_wire = |(picture, camera): &(u32, Option<Camera>)| v1::PictureCamera {
            picture: *picture,
            camera: camera.map(Into::into),
        };
        let wire = v1::UpdateFrameStreamRequest {
            stream: Bytes::copy_from_slice(stream),
            cameras: cameras.iter().map(to_wire).collect(),
        };
        let reply = FrameServiceClient::new(self.channel.clone()).update_frame_stream(wire).await;
        Ok(self.reply(reply)?.camera_version)
    }
}

fn single_chunk(message: v1::RenderFrameResponse) -> Option<v1::FrameChunk> {
    message.part.map(|v1::render_frame_response::Part::Chunk(chunk)| chunk)
}

fn stream_chunk(message: v1::StreamFramesResponse) -> Option<v1::FrameChunk> {
    match message.part {
        Some(StreamPart::Chunk(chunk)) => Some(chunk),
        Some(StreamPart::Settings(_)) | None => None,
    }
}

/// A stream of frames; dropping it unsubscribes.
pub struct FrameStream {
    settings: v1::FrameStreamSettings,
    frames: DecodedReplies<v1::StreamFramesResponse, ChunkDecoder<v1::StreamFramesResponse, v1::FrameChunk>>,
}

impl FrameStream {
    /// The settings in effect, with all defaults resolved by the server.
    pub const fn settings(&self) -> &v1::FrameStreamSettings {
        &self.settings
    }

    /// The next frame, or `None` after the requested number of steps. The frames of a step arrive in the order of the
    /// pictures.
    pub async fn next(&mut self) -> Option<Result<Frame>> {
        self.frames.next().await
    }
}

impl tokio_stream::Stream for FrameStream {
    type Item = Result<Frame>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.frames.poll(context)
    }
}

impl WireChunk for v1::FrameChunk {
    type Head = v1::FrameHead;
    type Reply = Frame;
    const NAME: &'static str = "frame";

    fn into_chunk(self, memory: &CallMemory) -> Result<Chunk<Self::Head>> {
        let is_shared = self.shared.is_some();
        let mut data = memory.data(self.data, self.shared)?;
        // The data of a frame in one chunk become the frame, which the caller may hold for any time.
        if is_shared && self.head.as_ref().is_some_and(|head| head.total == data.len() as u64) {
            data = Bytes::copy_from_slice(&data);
        }
        Ok(Chunk::new(self.head, |head| head.total, self.offset, data))
    }

    fn decode_reply(head: Self::Head, bytes: Bytes) -> Result<Frame> {
        let (format, pixel_bytes) = match head.format() {
            v1::Format::Png => (FrameFormat::Png, None),
            v1::Format::Jpeg => (FrameFormat::Jpeg, None),
            v1::Format::Rgb => (FrameFormat::Rgb, Some(3)),
            v1::Format::Rgba => (FrameFormat::Rgba, Some(4)),
            v1::Format::F32 => (FrameFormat::F32, Some(4)),
            v1::Format::U32 => (FrameFormat::U32, Some(4)),
            v1::Format::F32x3 => (FrameFormat::F32x3, Some(12)),
            v1::Format::Unspecified => {
                return Err(malformed_reply("frame.format", "a known format", head.format));
            }
        };
        let pixel_count = u64::from(head.width) * u64::from(head.height);
        let expected_bytes = pixel_bytes.map(|pixel_bytes: u64| pixel_bytes * pixel_count);
        if let Some(expected_bytes) = expected_bytes.filter(|expected_bytes| *expected_bytes != bytes.len() as u64) {
            return Err(malformed_reply("frame.total", format!("{expected_bytes} bytes"), bytes.len()));
        }
        let step = head.step.ok_or_else(|| malformed_reply("frame.step", "a step", "none"))?;
        Ok(Frame {
            step,
            picture: head.picture as usize,
            camera_version: head.camera_version,
            width: head.width,
            height: head.height,
            format,
            bytes,
            skipped: head.skipped,
            shadow_drawn_by: decode_drawn_by(head.shadow_drawn_by()),
            visibility_drawn_by: decode_drawn_by(head.visibility_drawn_by()),
            look: head.look.as_ref().map(decode_look),
            below_ground: head.below_ground,
            reframed: head.reframed,
            stages: stages::from_wire(head.stages),
        })
    }
}

const fn decode_drawn_by(wire: v1::DrawnBy) -> Option<DrawnBy> {
    match wire {
        v1::DrawnBy::Unspecified => None,
        v1::DrawnBy::Opengl => Some(DrawnBy::OpenGl),
        v1::DrawnBy::Cuda => Some(DrawnBy::Cuda),
    }
}

fn decode_look(wire: &v1::FrameLook) -> FrameLook {
    FrameLook {
        preset: match wire.preset() {
            v1::LookPreset::Unspecified => "",
            v1::LookPreset::Preview => "preview",
            v1::LookPreset::Standard => "standard",
            v1::LookPreset::Best => "best",
        },
        antialiasing: match wire.antialiasing() {
            v1::Antialiasing::Unspecified => "",
            v1::Antialiasing::None => "none",
            v1::Antialiasing::Fxaa => "fxaa",
            v1::Antialiasing::Samples => "samples",
        },
        samples: wire.samples,
        shadow_method: match wire.shadow_method() {
            v1::ShadowMethod::Unspecified => "",
            v1::ShadowMethod::Variance => "variance",
            v1::ShadowMethod::Standard => "standard",
            v1::ShadowMethod::Filtered => "filtered",
        },
        shadow_size: wire.shadow_size,
    }
}

impl Pictures {
    fn to_wire(&self) -> Vec<v1::Picture> {
        self.0.iter().copied().map(Into::into).collect()
    }
}

impl From<Picture> for v1::Picture {
    fn from(picture: Picture) -> Self {
        let (output, mode, scale_max) = match picture.output {
            Output::Color => (v1::Output::Color, 0, 0.0),
            Output::Depth => (v1::Output::Depth, 0, 0.0),
            Output::DepthWithGround => (v1::Output::DepthWithGround, 0, 0.0),
            Output::Domains => (v1::Output::Domains, 0, 0.0),
            Output::Normals => (v1::Output::Normals, 0, 0.0),
            Output::Displacement { scale_max } => (v1::Output::Displacement, 0, scale_max),
            Output::ModeShape { mode, scale_max } => (v1::Output::ModeShape, mode, scale_max),
        };
        // `Unspecified` selects the only format of depth, domains and normals, and PNG for the other outputs. The
        // server rejects the number formats for the other outputs.
        let format = match (picture.output, picture.format) {
            (Output::Depth | Output::DepthWithGround | Output::Domains | Output::Normals, _)
            | (_, FrameFormat::Png) => v1::Format::Unspecified,
            (_, FrameFormat::Jpeg) => v1::Format::Jpeg,
            (_, FrameFormat::Rgb) => v1::Format::Rgb,
            (_, FrameFormat::Rgba) => v1::Format::Rgba,
            (_, FrameFormat::F32) => v1::Format::F32,
            (_, FrameFormat::U32) => v1::Format::U32,
            (_, FrameFormat::F32x3) => v1::Format::F32x3,
        };
        Self {
            width: picture.width,
            height: picture.height,
            format: format.into(),
            camera: picture.camera.map(Into::into),
            output: output.into(),
            mode,
            largest: scale_max,
            jpeg_quality: if format == v1::Format::Jpeg { picture.jpeg_quality } else { 0 },
            edge_width: picture.edge_width,
            samples: picture.samples,
        }
    }
}

impl From<Camera> for v1::Camera {
    fn from(camera: Camera) -> Self {
        use v1::camera::{Lens as WireLens, View as WireView};
        let view = match camera.view {
            View::LookAt { eye, target, up } => {
                let up = up.map_or_else(Vec::new, Vec::from);
                WireView::LookAt(v1::LookAt { eye: eye.into(), target: target.into(), up })
            }
            View::Pose(pose) => WireView::Pose(v1::Pose { world_from_camera: pose.into() }),
        };
        let lens = match camera.lens {
            Lens::FieldOfView(degrees) => WireLens::FieldOfView(degrees),
            Lens::Intrinsics { fx, fy, cx, cy } => WireLens::Intrinsics(v1::Intrinsics { fx, fy, cx, cy }),
        };
        // On the wire, 0 and 0 mean that the server fits the clip distances to the scene.
        let (near, far) = camera.clip.unwrap_or((0.0, 0.0));
        Self { view: Some(view), lens: Some(lens), near, far }
    }
}
