//! The output of a step that a reader requests.

use std::sync::Arc;

use super::frame_format::FrameFormat;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::scene::{CameraSource, FrameSize, FrameStyle, PixelRect};

/// The output that a client requests of a step.
#[derive(Debug, Clone, PartialEq)]
pub enum OutputSpec {
    /// At least one picture.
    Frames(Arc<[PictureSpec]>),
    Vertices(VertexAttributes),
    /// The surface points at the pixels of a rectangle.
    Pick {
        camera: CameraSource,
        /// Size of the picture that contains the rectangle.
        picture: FrameSize,
        rectangle: PixelRect,
    },
    /// q and the transforms. The device does no work for them.
    State,
}

/// What a picture shows. Equal pictures of a step have equal pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureSpec {
    pub camera: CameraSource,
    pub size: FrameSize,
    pub output: FrameOutput,
    /// Ignored for outputs other than [`FrameOutput::Color`].
    pub style: FrameStyle,
}

/// The forms in which the readers of a color picture want it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::engine) struct PictureContent {
    pub pixels: bool,
    /// The PNG file. If the device does not encode it, the pixels are delivered instead.
    pub png: bool,
}

impl PictureContent {
    pub(in crate::engine) const PIXELS: Self = Self { pixels: true, png: false };

    /// The content for readers of these formats.
    pub(in crate::engine) fn of_formats(formats: &[FrameFormat]) -> Self {
        let is_png = |format: &FrameFormat| *format == FrameFormat::Png;
        Self { pixels: !formats.iter().all(is_png), png: formats.iter().any(is_png) }
    }

    pub(in crate::engine) const fn union(self, other: Self) -> Self {
        Self { pixels: self.pixels || other.pixels, png: self.png || other.png }
    }

    /// Whether readers of another content can use this one. A file can be encoded from pixels.
    pub(in crate::engine) const fn can_serve(self, other: Self) -> bool {
        self.pixels || !other.pixels
    }
}

/// The quantity that a frame shows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum FrameOutput {
    #[default]
    Color,
    /// [`modalcast_render::Aov::Depth`], in meters.
    Depth,
    /// [`modalcast_render::Aov::DepthWithGround`], in meters.
    DepthWithGround,
    /// [`modalcast_render::Aov::Domains`]: indices of domains.
    Domains,
    /// [`modalcast_render::Aov::Normals`].
    Normals,
    /// The distance of each vertex from T x0 as a color map.
    Displacement {
        /// The value at the bright end of the scale in meters; 0 fits the scale to each frame.
        scale_max: f64,
    },
    /// One column of U as a color map.
    ModeShape {
        mode: u32,
        /// The value at the bright end of the scale in meters per unit of the coordinate; 0 fits the scale to each
        /// frame.
        scale_max: f64,
    },
}
