//! Frame requests and streams: each reply is a complete frame with its step and stage times.

use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use v1::frame_service_client::FrameServiceClient;

use crate::assemble::{Part, Piece, Replies};
use crate::client::Client;
use crate::error::{Error, Result, malformed};

/// Milliseconds per processing stage, under the server's stage names and in its order.
pub type Stages = Vec<(String, f32)>;

/// Encoding of the bytes of a frame, top row first: 8-bit sRGB, or numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Format {
    #[default]
    Png,
    Rgba,
    /// Little-endian f32, one per pixel: depth in meters. A request need not name this format; the frame states it.
    F32,
    /// Little-endian u32, one per pixel: domain indices.
    U32,
    /// Little-endian f32, three per pixel: normals.
    F32x3,
}

/// The quantity that a picture shows; `frames.proto` defines each in detail.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Output {
    #[default]
    Colour,
    /// Meters along the view axis; infinity in the background.
    Depth,
    /// Index of the domain; `u32::MAX` in the background.
    Domains,
    /// Unit normals; zeros in the background.
    Normals,
    /// |u| as a color map with a legend. `largest` is the value at the bright end in meters; 0 fits it to each frame.
    Displacement { largest: f64 },
    /// One column of U as a color map with a legend.
    ModeShape { mode: u32, largest: f64 },
}

/// Which steps a subscriber receives.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Delivery {
    /// Every step, in order; back-pressure from a slow reader slows the writer.
    #[default]
    Lossless,
    /// The newest step; skipped steps are counted.
    Latest,
}

/// The pose of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    LookAt {
        eye: [f64; 3],
        target: [f64; 3],
        up: [f64; 3],
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

/// A camera. `clip` is the near and far distance in scene units; `None` fits them to the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    pub view: View,
    pub lens: Lens,
    pub clip: Option<(f64, f64)>,
}

/// Size, format, camera and output of a picture. Without a camera the server frames the scene; 0 x 0 means 1280 x 720.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Picture {
    pub width: u32,
    pub height: u32,
    pub format: Format,
    pub camera: Option<Camera>,
    pub output: Output,
}

/// Which step a single reply must show.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum Wanted {
    #[default]
    Newest,
    Exactly(u64),
    AtLeast(u64),
}

/// A request for one frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FrameRequest {
    pub scene: String,
    pub picture: Picture,
    at: Wanted,
    deadline_ms: u32,
}

impl FrameRequest {
    /// A PNG of the newest state of a scene, 1280 x 720.
    pub fn of(scene: &str) -> Self {
        Self { scene: scene.to_owned(), ..Self::default() }
    }

    /// Sets the size in pixels.
    #[must_use]
    pub const fn size(mut self, width: u32, height: u32) -> Self {
        (self.picture.width, self.picture.height) = (width, height);
        self
    }

    /// Exactly this step of the current run. The server refuses a step that it no longer has.
    #[must_use]
    pub const fn exactly(mut self, step: u64) -> Self {
        self.at = Wanted::Exactly(step);
        self
    }

    /// This step of the current run or a later one.
    #[must_use]
    pub const fn at_least(mut self, step: u64) -> Self {
        self.at = Wanted::AtLeast(step);
        self
    }

    /// How long the server may wait for the step and the picture, in milliseconds; 0 selects the server's default.
    #[must_use]
    pub const fn within_ms(mut self, milliseconds: u32) -> Self {
        self.deadline_ms = milliseconds;
        self
    }
}

/// A subscription to frames; with `frames` = 0 it never ends.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FramesRequest {
    pub scene: String,
    pub picture: Picture,
    pub delivery: Delivery,
    pub frames: u64,
}

/// One frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The step that the frame shows.
    pub step: v1::StepId,
    pub width: u32,
    pub height: u32,
    pub format: Format,
    /// A PNG file, or 4 or 12 bytes per pixel.
    pub bytes: Bytes,
    /// Number of steps skipped since the previous frame of the stream.
    pub skipped: u64,
    pub stages: Stages,
    /// For color frames: the rasterizer of the shadow map (`None` if the map is shared with another frame of the step)
    /// and of the visible triangles.
    pub shadow_drawn_by: Option<DrawnBy>,
    pub visibility_drawn_by: Option<DrawnBy>,
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
    /// `Refused` if the scene or the step does not exist or the deadline passed; `Malformed`; `Connect`.
    pub async fn frame(&self, request: &FrameRequest) -> Result<Frame> {
        use v1::render_frame_request::Step;
        let wire = v1::RenderFrameRequest {
            scene: request.scene.clone(),
            picture: Some(request.picture.into()),
            step: match request.at {
                Wanted::Newest => None,
                Wanted::Exactly(step) => Some(Step::ExactStep(step)),
                Wanted::AtLeast(step) => Some(Step::MinimumStep(step)),
            },
            deadline_ms: request.deadline_ms,
        };
        let stream = FrameServiceClient::new(self.channel.clone()).render_frame(wire).await?.into_inner();
        let frame = Replies::new(stream, self.reply_limit).next().await;
        frame.unwrap_or(Err(Error::Ended { what: "the frame" }))
    }

    /// Subscribes to frames. When this returns, the server has accepted the subscription, so that no later step is
    /// missed.
    ///
    /// # Errors
    /// `Refused` if the scene does not exist; `Connect`.
    pub async fn frames(&self, request: &FramesRequest) -> Result<Frames> {
        let wire = v1::StreamFramesRequest {
            scene: request.scene.clone(),
            picture: Some(request.picture.into()),
            delivery: v1::Delivery::from(request.delivery).into(),
            frames: request.frames,
        };
        let stream = FrameServiceClient::new(self.channel.clone()).stream_frames(wire).await?.into_inner();
        Ok(Frames(Replies::new(stream, self.reply_limit)))
    }
}

/// A stream of frames; dropping it unsubscribes.
pub struct Frames(Replies<v1::StreamFramesResponse>);

impl Frames {
    /// The next frame, or `None` after the requested number of frames.
    pub async fn next(&mut self) -> Option<Result<Frame>> {
        self.0.next().await
    }
}

impl tokio_stream::Stream for Frames {
    type Item = Result<Frame>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll(context)
    }
}

impl Part for v1::RenderFrameResponse {
    type Head = v1::FrameHead;
    type Whole = Frame;
    const WHAT: &'static str = "frame";

    fn piece(self) -> Result<Piece<Self::Head>> {
        piece(self.chunk)
    }

    fn whole(head: Self::Head, bytes: Bytes) -> Result<Frame> {
        frame(head, bytes)
    }
}

impl Part for v1::StreamFramesResponse {
    type Head = v1::FrameHead;
    type Whole = Frame;
    const WHAT: &'static str = "frame";

    fn piece(self) -> Result<Piece<Self::Head>> {
        piece(self.chunk)
    }

    fn whole(head: Self::Head, bytes: Bytes) -> Result<Frame> {
        frame(head, bytes)
    }
}

fn piece(chunk: Option<v1::FrameChunk>) -> Result<Piece<v1::FrameHead>> {
    let chunk = chunk.ok_or_else(|| malformed("frame.chunk", "a chunk", "none"))?;
    let head = chunk.head.map(|head| (head.total, head)).map(|(total, head)| (head, total));
    Ok(Piece { head, offset: chunk.offset, data: chunk.data })
}

fn frame(head: v1::FrameHead, bytes: Bytes) -> Result<Frame> {
    let (format, size) = match head.format() {
        v1::Format::Png => (Format::Png, None),
        v1::Format::Rgba => (Format::Rgba, Some(4)),
        v1::Format::F32 => (Format::F32, Some(4)),
        v1::Format::U32 => (Format::U32, Some(4)),
        v1::Format::F32x3 => (Format::F32x3, Some(12)),
        v1::Format::Unspecified => return Err(malformed("frame.format", "a format that is named", head.format)),
    };
    let pixels = u64::from(head.width) * u64::from(head.height);
    if let Some(total) = size.map(|size: u64| size * pixels).filter(|total| *total != bytes.len() as u64) {
        return Err(malformed("frame.total", format!("{total} bytes"), bytes.len()));
    }
    let step = head.step.ok_or_else(|| malformed("frame.step", "a step", "none"))?;
    Ok(Frame {
        step,
        width: head.width,
        height: head.height,
        format,
        bytes,
        skipped: head.skipped,
        shadow_drawn_by: drawn_by(head.shadow_drawn_by()),
        visibility_drawn_by: drawn_by(head.visibility_drawn_by()),
        stages: stages(head.stages),
    })
}

const fn drawn_by(wire: v1::DrawnBy) -> Option<DrawnBy> {
    match wire {
        v1::DrawnBy::Unspecified => None,
        v1::DrawnBy::Opengl => Some(DrawnBy::OpenGl),
        v1::DrawnBy::Cuda => Some(DrawnBy::Cuda),
    }
}

pub(crate) fn stages(wire: Vec<v1::StageTime>) -> Stages {
    wire.into_iter().map(|time| (time.stage, time.milliseconds)).collect()
}

impl From<Delivery> for v1::Delivery {
    fn from(delivery: Delivery) -> Self {
        match delivery {
            Delivery::Lossless => Self::Lossless,
            Delivery::Latest => Self::Latest,
        }
    }
}

impl From<Picture> for v1::Picture {
    fn from(picture: Picture) -> Self {
        let (output, mode, largest) = match picture.output {
            Output::Colour => (v1::Output::Colour, 0, 0.0),
            Output::Depth => (v1::Output::Depth, 0, 0.0),
            Output::Domains => (v1::Output::Domains, 0, 0.0),
            Output::Normals => (v1::Output::Normals, 0, 0.0),
            Output::Displacement { largest } => (v1::Output::Displacement, 0, largest),
            Output::ModeShape { mode, largest } => (v1::Output::ModeShape, mode, largest),
        };
        // Depth, domains and normals have a single format each, which the server chooses.
        let format = match (picture.output, picture.format) {
            (Output::Depth | Output::Domains | Output::Normals, _) | (_, Format::Png) => v1::Format::Unspecified,
            (_, Format::Rgba) => v1::Format::Rgba,
            (_, Format::F32) => v1::Format::F32,
            (_, Format::U32) => v1::Format::U32,
            (_, Format::F32x3) => v1::Format::F32x3,
        };
        let camera = picture.camera.map(Into::into);
        let (width, height) = (picture.width, picture.height);
        Self { width, height, format: format.into(), camera, output: output.into(), mode, largest }
    }
}

impl From<Camera> for v1::Camera {
    fn from(camera: Camera) -> Self {
        use v1::camera::{Lens as WireLens, View as WireView};
        let view = match camera.view {
            View::LookAt { eye, target, up } => {
                WireView::LookAt(v1::LookAt { eye: eye.into(), target: target.into(), up: up.into() })
            }
            View::Pose(pose) => WireView::Pose(v1::Pose { world_from_camera: pose.into() }),
        };
        let lens = match camera.lens {
            Lens::FieldOfView(degrees) => WireLens::FieldOfView(degrees),
            Lens::Intrinsics { fx, fy, cx, cy } => WireLens::Intrinsics(v1::Intrinsics { fx, fy, cx, cy }),
        };
        let (near, far) = camera.clip.unwrap_or_default();
        Self { view: Some(view), lens: Some(lens), near, far }
    }
}
