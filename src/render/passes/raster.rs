//! Passes of the compute rasterizer: the draws, and the conversion of visibility keys to ids. A key is the triangle and
//! the depth of a pixel.

use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::MemoryBarriers;
use crate::layout::{TILE, WORDS_BINDING};
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::resources::compute_rasterizer::{ComputeRasterizer, RasterPasses};
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::shared_targets::RasterViews;
use crate::types::{FrameParams, RasterBackend};
use crate::uniforms::frame::{clip_from_positions, shadow_clip_from_positions};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::Viewport;

/// Image unit of the ids.
const IDS_IMAGE: u32 = 0;

impl RasterPasses {
    /// The pass under which statistics and times report the draw of these passes.
    pub(crate) const fn stats_pass(self) -> Pass {
        if self.shadow { Pass::RasterShadow } else { Pass::RasterVisibility }
    }
}

/// What the compute rasterizer draws for the selected passes of a frame.
///
/// # Errors
/// `Invalid` if a side of the frame is out of range.
pub(crate) fn views(buffers: &SceneBuffers, params: &FrameParams, passes: RasterPasses) -> Result<RasterViews> {
    let (scene, look, origin) = (&buffers.scene, &buffers.look, buffers.origin);
    // Without a shadow map, the size is not used.
    let map_size = look.shadow.map_or(1, |shadow| shadow.size);
    let shadow = match passes.shadow {
        true => Some(Viewport::new(&shadow_clip_from_positions(scene, look, params, origin), map_size, map_size)?),
        false => None,
    };
    let frame = match passes.visibility {
        true => Some(Viewport::new(&clip_from_positions(scene, params, origin), params.width, params.height)?),
        false => None,
    };
    Ok(RasterViews { shadow, frame })
}

/// Draws the selected passes of a frame with the compute rasterizer into mapped buffers. Several calls draw consecutive
/// ranges of all triangles.
pub(crate) fn draw(
    recorder: &mut PassRecorder<'_>,
    compute_rasterizer: &ComputeRasterizer,
    passes: RasterPasses,
    views: &RasterViews,
    range: PieceRange,
) -> Result<()> {
    recorder.begin(passes.stats_pass());
    compute_rasterizer.draw(recorder.gl, views, range)?;
    record(recorder, passes);
    Ok(())
}

/// Uses the selected passes of a frame that the compute rasterizer has drawn into shared memory.
pub(crate) fn use_shared(recorder: &mut PassRecorder<'_>, passes: RasterPasses) {
    recorder.begin(passes.stats_pass());
    // OpenGL may hold older contents of the memory in its caches.
    recorder.gl.barrier(MemoryBarriers::SHADER_STORAGE);
    recorder.stats.shares_samples = true;
    record(recorder, passes);
}

fn record(recorder: &mut PassRecorder<'_>, passes: RasterPasses) {
    recorder.add_to_stats(passes.stats_pass());
    recorder.stats.raster_backends.shadow = passes.shadow.then_some(RasterBackend::Cuda);
    recorder.stats.raster_backends.visibility = passes.visibility.then_some(RasterBackend::Cuda);
}

/// Converts the visibility keys to ids.
pub(crate) fn unpack(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    compute_rasterizer: &ComputeRasterizer,
) -> Result<()> {
    let target = frame.target;
    let missing_keys = || fault_in(Pass::Unpack.name())("expected visibility keys, got none");
    let (keys, program) = compute_rasterizer.unpack_input().ok_or_else(missing_keys)?;
    recorder.begin(Pass::Unpack);
    program.bind(None);
    keys.bind_storage(WORDS_BINDING);
    target.ids.bind_image(IDS_IMAGE);
    target.dirty_regions.ids.mark_all();
    recorder.gl.dispatch(target.desc.width.div_ceil(TILE), target.desc.height.div_ceil(TILE));
    recorder.finish(Pass::Unpack)
}
