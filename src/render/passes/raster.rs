//! Passes of the compute rasterizer: its draws, and the conversion of its keys to ids.

use super::recorder::{FrameContext, PassRecorder};
use crate::layout::{TILE, WORDS_BINDING};
use crate::pass::Pass;
use crate::resources::compute_rasterizer::{ComputeRasterizer, RasterPasses};
use crate::types::RasterBackend;
use crate::uniforms::frame::{clip_from_positions, shadow_clip_from_positions};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::Viewport;

/// Image unit of the ids.
const IDS_IMAGE: u32 = 0;

impl RasterPasses {
    /// The pass under whose name the draw of these passes is listed and timed.
    pub(crate) const fn name(self) -> Pass {
        if self.shadow { Pass::RasterShadow } else { Pass::RasterVisibility }
    }
}

/// Draws the selected outputs of this frame.
pub(crate) fn draw(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    compute_rasterizer: &ComputeRasterizer,
    passes: RasterPasses,
) -> Result<()> {
    let FrameContext { buffers, shot, .. } = *frame;
    let (scene, origin) = (&buffers.scene, buffers.origin);
    let side = scene.look.shadow.map_or(1, |shadow| shadow.size);
    let map = match passes.shadow {
        true => Some(Viewport::new(&shadow_clip_from_positions(scene, shot, origin), side, side)?),
        false => None,
    };
    let view = Viewport::new(&clip_from_positions(scene, shot, origin), shot.width, shot.height)?;
    recorder.begin(passes.name());
    compute_rasterizer.draw(recorder.gl, map.as_ref(), passes.visibility.then_some(&view))?;
    recorder.stats.passes.push(passes.name());
    recorder.stats.raster_backends.shadow = passes.shadow.then_some(RasterBackend::Cuda);
    recorder.stats.raster_backends.visibility = passes.visibility.then_some(RasterBackend::Cuda);
    Ok(())
}

/// Converts the keys to the ids that the camera sees, including the ground.
pub(crate) fn unpack(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    compute_rasterizer: &ComputeRasterizer,
) -> Result<()> {
    let target = frame.target;
    let missing = || fault_in(Pass::Unpack.name())("no keys were drawn");
    let (keys, program) = compute_rasterizer.unpack_input().ok_or_else(missing)?;
    recorder.begin(Pass::Unpack);
    program.bind(None);
    keys.bind_storage(WORDS_BINDING);
    target.ids.bind_image(IDS_IMAGE);
    target.dirty.ids.mark_all();
    recorder.gl.dispatch(target.desc.width.div_ceil(TILE), target.desc.height.div_ceil(TILE));
    recorder.finish(Pass::Unpack)
}
