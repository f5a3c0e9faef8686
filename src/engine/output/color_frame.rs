//! Color pixels of one step and their PNG.

use bytes::Bytes;
use tokio::sync::OnceCell;

use modalcast_render::{FrameImage, RasterBackends};

/// Color pixels of one step. All subscribers with the same view share them. The PNG is encoded once, on first use.
#[derive(Debug)]
pub struct ColorFrame {
    pub width: u32,
    pub height: u32,
    /// RGBA8 sRGB, top row first.
    pub rgba: Bytes,
    /// The rasterizers that drew the frame.
    pub(super) raster_backends: RasterBackends,
    /// The PNG and the milliseconds that encoding took.
    pub(super) png: OnceCell<(Bytes, f64)>,
}

impl From<FrameImage> for ColorFrame {
    fn from(image: FrameImage) -> Self {
        let FrameImage { width, height, rgba, raster_backends, .. } = image;
        Self { width, height, rgba: rgba.into(), raster_backends, png: OnceCell::new() }
    }
}
