//! Render target of a frame: ids, depth and blended layer of each sample, the picture, and the buffers for its
//! readback.

use std::cell::Cell;
use std::ops::Range;
use std::rc::Rc;

use super::cull::{COUNT_BYTES, Pyramid};
use super::gl::{self, Buffer, Framebuffer, Gl, Texture, TextureKind, Traces};
use super::lists::{HEAD, ListTarget};
use super::region::{Region, Touched};
use super::ring::Ring;
use super::shaders::TILE;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, Look};

/// Maximum number of pixels of a multisampled frame: with depth, ids and a blended layer they take 704 MiB of device
/// memory. Larger frames are drawn with one sample per pixel.
const MULTISAMPLED_PIXELS: u64 = 11 << 20;

/// Properties of a frame that determine its images and buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Form {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) samples: u32,
    pub(super) blended: Blended,
    /// Levels of the bloom pyramid below the picture's size.
    pub(super) halvings: u32,
    /// Culling method; never the automatic choice.
    pub(super) culling: Culling,
}

/// Resources that a frame needs for blended triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Blended {
    None,
    /// A layer into which they are blended in draw order.
    Drawn,
    /// Lists with this budget of fragments.
    Listed(u32),
}

/// The images and buffers of frames of one form.
#[derive(Debug)]
pub(super) struct Target {
    pub(super) form: Form,
    /// Id of each sample; kept until the next frame, like depth.
    pub(super) ids: Texture,
    pub(super) visible: Framebuffer,
    pub(super) touched: Traces,
    /// Region of the current frame that may show triangles or rasterized ground.
    pub(super) reach: Cell<Region>,
    pub(super) layer: Option<Layer>,
    pub(super) lists: Option<ListTarget>,
    /// Indirect dispatch arguments, then the tiles that see triangles.
    pub(super) tiles: Buffer,
    /// Linear light, one value per pixel.
    pub(super) picture: Texture,
    /// Bright light of each pixel, then levels of half the size; empty without bloom.
    pub(super) glow: Vec<Texture>,
    /// RGBA8, top row first, as the encoder writes it.
    pub(super) packed: Buffer,
    /// Staging buffers for the readback of `packed`.
    pub(super) ring: Rc<Ring>,
    /// Depth pyramid of occlusion culling.
    pub(super) pyramid: Option<Pyramid>,
    // Attached to framebuffers, which must not outlive it.
    pub(super) depth: Texture,
}

/// Blended light of the translucent triangles per sample, and their transmittance in alpha.
#[derive(Debug)]
pub(super) struct Layer {
    pub(super) framebuffer: Framebuffer,
    pub(super) colour: Texture,
    pub(super) touched: Touched,
}

impl Form {
    /// No pixels and no optional features.
    pub(super) const EMPTY: Self =
        Self { width: 0, height: 0, samples: 1, blended: Blended::None, halvings: 0, culling: Culling::None };

    /// The form of a frame of a look.
    pub(super) fn new(gl: &Gl, [width, height]: [u32; 2], look: &Look, blended: Blended) -> Self {
        let halvings = look.bloom.map_or(0, |bloom| bloom.levels);
        Self { blended, halvings, ..Self::plain(gl, [width, height], look.samples_a_pixel()) }
    }

    /// The form of a frame with ids and depth only, with `wanted` samples per pixel if the device and the frame size
    /// allow it, else one.
    pub(super) fn plain(gl: &Gl, [width, height]: [u32; 2], wanted: u32) -> Self {
        let fits = u64::from(width) * u64::from(height) <= MULTISAMPLED_PIXELS && wanted <= gl.limits.max_samples;
        Self { width, height, samples: if fits { wanted } else { 1 }, ..Self::EMPTY }
    }

    /// Bytes of the encoded picture.
    pub(super) fn bytes(&self) -> u64 {
        4 * u64::from(self.width) * u64::from(self.height)
    }

    /// Byte ranges of the list and culling statistics, which follow the picture in the staging buffer; empty without
    /// lists or culling.
    pub(super) fn told(&self) -> [Range<u64>; 2] {
        let lists = if matches!(self.blended, Blended::Listed(_)) { HEAD as u64 } else { 0 };
        let culled = if self.culling == Culling::None { 0 } else { COUNT_BYTES as u64 };
        let (first, second) = (self.bytes(), self.bytes() + lists);
        [first..second, second..second + culled]
    }
}

impl Target {
    pub(super) fn new(gl: &Rc<Gl>, form: Form) -> Result<Self> {
        let Form { width, height, samples, blended, .. } = form;
        let (ids, depth) = (image(gl, form, gl::R32UI)?, image(gl, form, gl::DEPTH_COMPONENT32F)?);
        let layer = |colour: Texture| {
            Ok(Layer { framebuffer: gl.framebuffer(Some(&colour), &depth)?, colour, touched: Touched::default() })
        };
        let layer = if blended == Blended::Drawn { Some(layer(image(gl, form, gl::RGBA16F)?)?) } else { None };
        let lists = match blended {
            Blended::Listed(budget) => Some(ListTarget::new(gl, form, budget, &depth)?),
            Blended::None | Blended::Drawn => None,
        };
        let bytes = form.bytes();
        Ok(Self {
            form: Form { samples, ..form },
            visible: gl.framebuffer(Some(&ids), &depth)?,
            touched: Traces::default(),
            reach: Cell::new(Region::whole([width, height])),
            ids,
            layer,
            lists,
            tiles: gl.buffer(
                16 + 4 * u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE)),
                gl::STREAM_COPY,
                None,
            )?,
            picture: image(gl, Form { samples: 1, ..form }, gl::RGBA16F)?,
            glow: super::post::glow(gl, form)?,
            packed: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            ring: Ring::new(gl, form.told()[1].end),
            pyramid: if form.culling == Culling::Depth { Some(Pyramid::new(gl, form, &depth)?) } else { None },
            depth,
        })
    }
}

/// Sample positions within a pixel with four samples; empty on a device without 4x multisampling.
pub(super) fn sample_places(gl: &Rc<Gl>) -> Result<Vec<[f32; 2]>> {
    let form = Form { width: 1, height: 1, samples: 4, ..Form::EMPTY };
    if gl.limits.max_samples < form.samples {
        return Ok(Vec::new());
    }
    let (ids, depth) = (image(gl, form, gl::R32UI)?, image(gl, form, gl::DEPTH_COMPONENT32F)?);
    gl.sample_places(&gl.framebuffer(Some(&ids), &depth)?, form.samples)
}

pub(super) fn image(gl: &Rc<Gl>, form: Form, format: u32) -> Result<Texture> {
    let Form { width, height, samples, .. } = form;
    let target = if samples > 1 { gl::TEXTURE_2D_MULTISAMPLE } else { gl::TEXTURE_2D };
    let texture = gl.texture(TextureKind { target, format, width, height, depth: samples, levels: 1 })?;
    if samples == 1 {
        texture.sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
    }
    Ok(texture)
}
