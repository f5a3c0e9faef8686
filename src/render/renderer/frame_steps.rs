//! The steps of a frame: its passes, their bands and the triangles that they draw.

use std::collections::VecDeque;

use super::frame_readback::{FrameReadback, MAX_BAND_PIXELS};
use crate::layout::TILE;
use crate::pass::Pass;
use crate::passes::ambient::AmbientStep;
use crate::passes::post::BloomStep;
use crate::passes::{self, FrameContext, OitFrame, PassRecorder};
use crate::pieces::{PieceLoad, PieceRange};
use crate::region::Band;
use crate::resources::compute_rasterizer::ComputeRasterizer;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::shadow_map::ShadowMap;
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::TargetDesc;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;
use modalcast_model::scene::Culling;

/// How many times longer a blended sample takes than one of a depth pass: it is shaded, or counted by an atomic operation.
const SHADED_SAMPLE_COST: u64 = 64;
/// As [`SHADED_SAMPLE_COST`], of a sample that is inserted into a sorted list.
const LISTED_SAMPLE_COST: u64 = 1024;
/// As [`SHADED_SAMPLE_COST`], of a list that is sorted and shaded.
const LIST_COST: u64 = 1 << 20;

/// Commands that are submitted without a break.
#[derive(Debug)]
pub(super) enum Step {
    /// The passes of the compute rasterizer, if there is one.
    ComputeRaster,
    /// Passes that are timed together under one name.
    Passes(Pass, Vec<BandPass>),
}

/// A pass, or a part of it.
#[derive(Debug, Clone, Copy)]
pub(super) enum BandPass {
    /// Depth of a layer of the shadow map.
    ShadowDepth(u32),
    /// Blur of a band of a layer of the shadow map.
    Blur(u32, Band),
    ListOccluders,
    DrawOccluders,
    Cull,
    Visibility(Band),
    RecordVisible,
    Ambient(AmbientStep, Band),
    Blended(Band),
    OitCount(Band),
    OitSumCounts,
    OitAllocate(Band),
    OitFill(Band),
    OitFillIds(Band),
    OitResolve(Band),
    Shade(Band),
    Bloom(BloomStep, Band),
    Encode(Band),
    Read(Band),
}

impl Step {
    /// What the step draws in pieces. `None` for a step of one piece.
    pub(super) fn load(&self, frame: &FrameContext<'_>) -> Option<PieceLoad> {
        match self {
            Self::ComputeRaster => {
                let (_, enabled) = frame.buffers.active_rasterizer()?;
                let [shadow, camera] = [shadow_samples(frame.buffers), camera_samples(frame, None)];
                let samples = if enabled.visibility { shadow.max(camera) } else { shadow };
                Some(PieceLoad { items: frame.buffers.all_triangles(), samples, sample_cost: 1 })
            }
            Self::Passes(_, band_passes) => band_passes.iter().find_map(|band_pass| band_pass.load(frame)),
        }
    }
}

impl BandPass {
    /// As [`Step::load`].
    fn load(self, frame: &FrameContext<'_>) -> Option<PieceLoad> {
        let buffers = frame.buffers;
        let opaque = |samples| PieceLoad { items: buffers.all_triangles(), samples, sample_cost: 1 };
        let blended = |band, sample_cost| {
            let samples = camera_samples(frame, Some(band));
            PieceLoad { items: buffers.triangle_range(BlendMode::Blend), samples, sample_cost }
        };
        match self {
            Self::ShadowDepth(_) => buffers.shadow_rasterizer().is_none().then(|| opaque(shadow_samples(buffers))),
            Self::DrawOccluders => visibility_rasterizer(frame).is_none().then(|| opaque(camera_samples(frame, None))),
            Self::Visibility(band) => {
                visibility_rasterizer(frame).is_none().then(|| opaque(camera_samples(frame, Some(band))))
            }
            Self::Blended(band) | Self::OitCount(band) => Some(blended(band, SHADED_SAMPLE_COST)),
            Self::OitFill(band) | Self::OitFillIds(band) => Some(blended(band, LISTED_SAMPLE_COST)),
            Self::OitResolve(band) => {
                let tiles = frame.target.desc.width.div_ceil(TILE) * band.rows.div_ceil(TILE);
                let samples = u64::from(TILE * TILE * frame.target.desc.samples);
                Some(PieceLoad { items: PieceRange::new(0, tiles as usize), samples, sample_cost: LIST_COST })
            }
            _ => None,
        }
    }
}

/// Samples of a layer of the shadow map.
fn shadow_samples(buffers: &SceneBuffers) -> u64 {
    buffers.shadow.as_ref().map_or(0, |map| u64::from(map.shadow.size).pow(2))
}

/// Samples of the region of a frame that may show triangles, in a band if there is one.
fn camera_samples(frame: &FrameContext<'_>, band: Option<Band>) -> u64 {
    let region = frame.target.draw_region.get();
    let [_, _, width, height] = band.map_or(region, |band| region.within(band)).rect().map(u64::from);
    width * height * u64::from(frame.target.desc.samples)
}

/// Inputs of the plan of a frame.
pub(super) struct FramePlan<'a> {
    pub(super) target: &'a RenderTarget,
    pub(super) has_readback: bool,
    /// Maximum number of pixels of a band.
    pub(super) max_pixels: u64,
    pub(super) has_pieces: bool,
}

impl FramePlan<'_> {
    /// The steps of the frame. `shadow`: the shadow map if the frame draws it.
    pub(super) fn steps(&self, shadow: Option<&ShadowMap>) -> VecDeque<Step> {
        let mut steps = VecDeque::from([Step::ComputeRaster]);
        self.push_groups(&mut steps, shadow.map(|map| self.shadow_groups(map)).into_iter().flatten());
        self.push_groups(&mut steps, self.cull_group());
        self.push_groups(&mut steps, self.camera_groups());
        steps
    }

    /// Appends a step for each group, or for each part of it if the frame is drawn in pieces.
    fn push_groups(&self, steps: &mut VecDeque<Step>, groups: impl IntoIterator<Item = (Pass, Vec<BandPass>)>) {
        for (pass, band_passes) in groups {
            if self.has_pieces {
                steps.extend(band_passes.into_iter().map(|band_pass| Step::Passes(pass, vec![band_pass])));
            } else {
                steps.push_back(Step::Passes(pass, band_passes));
            }
        }
    }

    /// The depth of the shadow map and its blur.
    fn shadow_groups(&self, map: &ShadowMap) -> [(Pass, Vec<BandPass>); 2] {
        let layers = 0..map.shadow.cascades;
        let bands = match self.has_pieces {
            true => passes::shadow::blur_bands(map, self.max_pixels),
            false => vec![Band::whole(map.shadow.size)],
        };
        let blur = layers.clone().flat_map(|layer| bands.iter().map(move |band| BandPass::Blur(layer, *band)));
        let depth = layers.clone().map(BandPass::ShadowDepth).collect();
        [(Pass::Shadow, depth), (Pass::Blur, blur.collect())]
    }

    /// Culling for the camera; none if triangles are not culled.
    fn cull_group(&self) -> Option<(Pass, Vec<BandPass>)> {
        let band_passes = match self.target.desc.culling {
            Culling::None => return None,
            Culling::Occlusion => vec![BandPass::ListOccluders, BandPass::DrawOccluders, BandPass::Cull],
            Culling::Triangles | Culling::Auto => vec![BandPass::Cull],
        };
        Some((Pass::Cull, band_passes))
    }

    /// The passes of the frame itself.
    fn camera_groups(&self) -> Vec<(Pass, Vec<BandPass>)> {
        let Self { target, has_readback, max_pixels, .. } = *self;
        let TargetDesc { width, height, .. } = target.desc;
        let bands = Band::divide([width, height], max_pixels);
        let of_bands = |pass: fn(Band) -> BandPass| bands.iter().copied().map(pass);
        let mut visibility: Vec<BandPass> = of_bands(BandPass::Visibility).collect();
        visibility.push(BandPass::RecordVisible);
        let blend_lists = |band: &Band| {
            let band = *band;
            [
                BandPass::OitAllocate(band),
                BandPass::OitFill(band),
                BandPass::OitFillIds(band),
                BandPass::OitResolve(band),
            ]
        };
        let blended = match (&target.blend_layer, &target.oit) {
            (_, Some(_)) => of_bands(BandPass::OitCount)
                .chain([BandPass::OitSumCounts])
                .chain(bands.iter().flat_map(blend_lists))
                .collect(),
            (Some(_), None) => of_bands(BandPass::Blended).collect(),
            (None, None) => Vec::new(),
        };
        let bloom = passes::post::bloom_steps(target).flat_map(|(step, image)| {
            let bands = Band::divide([image.desc.width, image.desc.height], max_pixels);
            bands.into_iter().map(move |band| BandPass::Bloom(step, band))
        });
        let ambient_bands = target.ambient.iter().flat_map(|images| {
            let bands = Band::divide([images.surface.desc.width, images.surface.desc.height], max_pixels);
            AmbientStep::ALL
                .into_iter()
                .flat_map(move |step| bands.clone().into_iter().map(move |band| BandPass::Ambient(step, band)))
        });
        let mut groups = vec![
            (Pass::Visibility, visibility),
            (Pass::AmbientOcclusion, ambient_bands.collect()),
            (Pass::Blended, blended),
            (Pass::Shade, of_bands(BandPass::Shade).collect()),
            (Pass::Bloom, bloom.collect()),
            (Pass::Encode, of_bands(BandPass::Encode).collect()),
        ];
        if has_readback && bands.len() > 1 {
            let bands = Band::divide([width, height], max_pixels.min(MAX_BAND_PIXELS));
            groups.push((Pass::Read, bands.into_iter().map(BandPass::Read).collect()));
        } else if has_readback {
            groups.push((Pass::Read, of_bands(BandPass::Read).collect()));
        }
        groups
    }
}

/// The compute rasterizer if it draws the visibility of a frame. It draws one sample per pixel, but a frame can set
/// another number than its scene.
pub(super) fn visibility_rasterizer<'a>(frame: &FrameContext<'a>) -> Option<&'a ComputeRasterizer> {
    frame.buffers.visibility_rasterizer().filter(|_| frame.target.desc.samples == 1)
}

/// Records a pass, or a band of it. A pass that draws triangles draws those in `range`.
pub(super) fn record(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    readback: Option<&FrameReadback>,
    band_pass: BandPass,
    range: PieceRange,
) -> Result<()> {
    let (rasterizer, shadow_cache) = (visibility_rasterizer(frame), &frame.buffers.shadow_cache);
    match (band_pass, OitFrame::of(frame)) {
        (BandPass::ShadowDepth(layer), _) => {
            shadow_cache.set_content(None);
            passes::shadow::draw_depth(recorder, frame, layer, range)
        }
        (BandPass::Blur(layer, band), _) => {
            passes::shadow::blur(recorder, frame.buffers, layer, band)?;
            let cascades = frame.buffers.shadow.as_ref().map_or(1, |map| map.shadow.cascades);
            if band.is_last() && layer + 1 == cascades {
                shadow_cache.set_content(frame.buffers.shadow_key(frame.params));
            }
            Ok(())
        }
        // The compute rasterizer culls for itself.
        (BandPass::ListOccluders | BandPass::DrawOccluders | BandPass::Cull, _) if rasterizer.is_some() => Ok(()),
        (BandPass::ListOccluders, _) => passes::cull::list_occluders(recorder, frame),
        (BandPass::DrawOccluders, _) => passes::cull::draw_occluders(recorder, frame, range),
        (BandPass::Cull, _) => passes::cull::cull_for_camera(recorder, frame),
        (BandPass::Visibility(band), _) => match rasterizer {
            // This pass only converts the output of the compute rasterizer, so the first band converts all rows.
            Some(rasterizer) if band.first_row == 0 => passes::raster::unpack(recorder, frame, rasterizer),
            Some(_) => Ok(()),
            None => passes::visibility::draw(recorder, frame, band, range),
        },
        (BandPass::RecordVisible, _) if rasterizer.is_none() => passes::cull::record_visible(recorder, frame),
        (BandPass::Ambient(step, band), _) => passes::ambient::draw(recorder, frame, step, band),
        (BandPass::Blended(band), _) => passes::blended::draw(recorder, frame, band, range),
        (BandPass::OitCount(band), Some(oit)) => oit.count(recorder, band, range),
        (BandPass::OitSumCounts, Some(oit)) => oit.sum_counts(recorder),
        (BandPass::OitAllocate(band), Some(oit)) => oit.allocate(recorder, band),
        (BandPass::OitFill(band), Some(oit)) => oit.fill(recorder, band, range),
        (BandPass::OitFillIds(band), Some(oit)) => oit.fill_ids(recorder, band, range),
        (BandPass::OitResolve(_), Some(oit)) => oit.resolve(recorder, range),
        (BandPass::Shade(band), _) => passes::shade::draw(recorder, frame, band),
        (BandPass::Bloom(step, band), _) => passes::post::bloom(recorder, frame, step, band),
        (BandPass::Encode(band), _) => passes::post::encode(recorder, frame, band),
        (BandPass::Read(band), _) => {
            let staging = readback.and_then(|readback| readback.buffer(frame.target.desc, band));
            passes::readback::copy_frame(recorder, frame, staging, band)
        }
        // Passes that OpenGL or a frame without fragment lists does not have.
        (
            BandPass::RecordVisible
            | BandPass::OitCount(_)
            | BandPass::OitSumCounts
            | BandPass::OitAllocate(_)
            | BandPass::OitFill(_)
            | BandPass::OitFillIds(_)
            | BandPass::OitResolve(_),
            _,
        ) => Ok(()),
    }
}
