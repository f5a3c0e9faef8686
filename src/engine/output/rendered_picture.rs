//! The pixels of one picture of a step and their encodings.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use tokio::sync::OnceCell;

use super::frame_format::FrameFormat;
use crate::engine::lock::lock;
use crate::frame::Legend;
use crate::telemetry::{Stage, StageTimes};
use modalcast_render::{AovImage, EncodedPng, FrameImage, FrameInfo, FramePixels, FrameTimes, RenderStage, TimeKey};

/// The pixels of one picture of a step. All readers of equal pictures share them, and share each encoding, which is
/// computed once, on first use.
#[derive(Debug)]
pub struct RenderedPicture {
    pub width: u32,
    pub height: u32,
    pub pixels: Pixels,
    /// Times of the stages from the upload to the readback.
    pub(super) stages: StageTimes,
    /// How a color picture was drawn. For others, only whether the camera was moved.
    pub(super) info: FrameInfo,
    /// At most one entry per format.
    encodings: Mutex<Vec<(FrameFormat, SharedEncoding)>>,
}

/// An encoded picture and the milliseconds that encoding took. Empty until the first encoding has ended.
pub(super) type SharedEncoding = Arc<OnceCell<(Bytes, f64)>>;

/// The content of a picture.
#[derive(Debug)]
pub enum Pixels {
    /// RGBA8 sRGB, top row first.
    Color(Bytes),
    /// Only the PNG file of a color picture, because no reader wanted the pixels.
    PngOnly,
    /// Little-endian numbers, top row first.
    Values(Bytes),
    /// Values that are drawn as a color map.
    ColorMap(AovImage, Legend),
}

impl RenderedPicture {
    /// A picture of an AOV, which has values instead of colors. With a legend (the scale of a color map), the values
    /// are drawn as colors. `is_reframed`: as [`FrameInfo::is_reframed`].
    pub(in crate::engine) fn from_aov(image: AovImage, legend: Option<Legend>, is_reframed: bool) -> Self {
        let (width, height, stages) = (image.width, image.height, stage_times(&image.times));
        let pixels = match legend {
            Some(legend) => Pixels::ColorMap(image, legend),
            None => Pixels::Values(image.bytes.into()),
        };
        let info = FrameInfo { is_reframed, ..FrameInfo::default() };
        Self { width, height, pixels, stages, info, encodings: Mutex::default() }
    }

    /// The cell for the encoding in a format. The caller encodes the picture if the cell is empty.
    pub(super) fn encoding(&self, format: FrameFormat) -> SharedEncoding {
        let mut encodings = lock(&self.encodings);
        if let Some((_, encoding)) = encodings.iter().find(|(encoded_format, _)| *encoded_format == format) {
            return Arc::clone(encoding);
        }
        let encoding = SharedEncoding::default();
        encodings.push((format, Arc::clone(&encoding)));
        encoding
    }
}

impl From<FrameImage<FramePixels>> for RenderedPicture {
    fn from(image: FrameImage<FramePixels>) -> Self {
        let FrameImage { width, height, rgba, times, info } = image;
        let mut encodings = Vec::new();
        let pixels = match rgba {
            FramePixels::Encoded(EncodedPng { png, ms, rgba }) => {
                let file = Bytes::from(png);
                let pixels = rgba.map_or(Pixels::PngOnly, |rgba| Pixels::Color(shared_bytes(*rgba)));
                encodings.push((FrameFormat::Png, Arc::new(OnceCell::new_with(Some((file, ms))))));
                pixels
            }
            rgba => Pixels::Color(shared_bytes(rgba)),
        };
        Self { width, height, pixels, stages: stage_times(&times), info, encodings: Mutex::new(encodings) }
    }
}

/// The pixels of a frame, without a copy.
fn shared_bytes(rgba: FramePixels) -> Bytes {
    match rgba {
        FramePixels::Copied(bytes) => bytes.into(),
        FramePixels::Held(pixels) => Bytes::from_owner(pixels),
        FramePixels::Encoded(encoded) => encoded.rgba.map(|rgba| shared_bytes(*rgba)).unwrap_or_default(),
    }
}

/// The times of a frame's stages. The times of its passes are omitted.
fn stage_times(times: &FrameTimes) -> StageTimes {
    let stage_of_key = |key: TimeKey| match key {
        TimeKey::Stage(RenderStage::Upload) => Some(Stage::Upload),
        TimeKey::Stage(RenderStage::Switch) => Some(Stage::Switch),
        TimeKey::Stage(RenderStage::Shadow) => Some(Stage::Shadow),
        TimeKey::Stage(RenderStage::Draw) => Some(Stage::Draw),
        TimeKey::Stage(RenderStage::Read) => Some(Stage::Read),
        TimeKey::Pass(_) => None,
    };
    times.iter().filter_map(|(key, ms)| Some((stage_of_key(key)?, ms))).collect()
}
