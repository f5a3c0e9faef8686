//! Deferred shading of the visible surfaces, by tiles (squares of 8 x 8 pixels).

use super::draw::{bind_shadow, bind_visibility};
use super::recorder::{FrameContext, PassRecorder};
use crate::layout::{
    AMBIENT_UNIT, BLEND_LAYER_UNIT, EMPTY_TILE_LIST, FRAGMENT_COUNT_UNIT, INNER_EDGES_BINDING, TILE, TILES_BINDING,
};
use crate::pass::Pass;
use crate::region::Band;
use modalcast_model::error::Result;

/// Image units of the outputs.
const COLOR_IMAGE: u32 = 0;
const BLOOM_IMAGE: u32 = 1;

/// Shades a band: shades tiles in which no triangle is visible and lists the other tiles; then shades the listed tiles.
pub(crate) fn draw(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>, band: Band) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    recorder.begin(Pass::Background);
    bind_shadow(buffers);
    bind_visibility(target);
    if let Some(layer) = &target.blend_layer {
        layer.color.bind(BLEND_LAYER_UNIT);
    }
    if let Some(oit) = &target.oit {
        oit.blend_layers.bind(BLEND_LAYER_UNIT);
        oit.fragment_counts.bind(FRAGMENT_COUNT_UNIT);
    }
    if let Some(images) = &target.ambient {
        images.visibility.bind(AMBIENT_UNIT);
    }
    target.scene_color.bind_image(COLOR_IMAGE);
    if let Some(finest_mip) = target.bloom_mips.first() {
        finest_mip.bind_image(BLOOM_IMAGE);
    }
    target.tile_list.write(bytemuck::cast_slice(&EMPTY_TILE_LIST));
    target.tile_list.bind_storage(TILES_BINDING);
    programs.background.bind(None);
    programs.background.set_first_row(band.first_row);
    recorder.gl.dispatch(target.desc.width.div_ceil(TILE), band.rows.div_ceil(TILE));
    recorder.finish(Pass::Background)?;
    let Some(program) = &programs.shade else { return Ok(()) };
    recorder.begin(Pass::Shade);
    if let Some(inner_edges) = buffers.inner_edges.get().filter(|_| programs.has_edges) {
        inner_edges.bind_storage(INNER_EDGES_BINDING);
    }
    program.bind(None);
    recorder.gl.dispatch_indirect(&target.tile_list);
    recorder.finish(Pass::Shade)
}
