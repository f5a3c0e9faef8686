//! Draws the shadow map: depth from the sun, and the blurred moments of a variance shadow map.

use super::cull::cull_shadow_casters;
use super::draw::{TriangleDraw, draw_double_sided, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState, Program, Texture};
use crate::layout::{SOURCE_UNIT, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::region::{Band, Region};
use crate::resources::compute_rasterizer::ComputeRasterizer;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::shadow_map::{BlurredMoments, ShadowMap};
use crate::scene_data::geometry::BlendMode;
use crate::shaders::shadow::{TEXELS_PER_INVOCATION, texels_per_workgroup};
use crate::types::RasterBackend;
use modalcast_model::error::{Result, fault_in};

/// Image unit that the blur writes.
const DESTINATION_IMAGE: u32 = 0;
/// Image unit of the copy of the compute rasterizer's depth.
const DEPTH_COPY_IMAGE: u32 = 1;

/// Draws the depth from the sun into a layer of the map, unless the compute rasterizer has drawn it. Each cascade of the
/// map is a layer. Several calls draw consecutive ranges of all triangles.
pub(crate) fn draw_depth(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    layer: u32,
    range: PieceRange,
) -> Result<()> {
    let FrameContext { buffers, has_pieces, .. } = *frame;
    let Some(map) = buffers.shadow.as_ref().filter(|_| buffers.shadow_rasterizer().is_none()) else { return Ok(()) };
    let Some(framebuffer) = map.framebuffers.get(layer as usize) else { return Ok(()) };
    recorder.stats.raster_backends.shadow = Some(RasterBackend::OpenGl);
    let (size, triangles) = (map.shadow.size, triangle_set(buffers));
    let is_first = range.first == 0;
    if is_first {
        cull_shadow_casters(recorder, buffers, size, has_pieces, |program| set_layer(program, map, layer))?;
    }
    recorder.begin(Pass::Shadow);
    let clear = if is_first { ClearOp::Depth(None) } else { ClearOp::Load };
    recorder.gl.begin_pass(framebuffer, Region::whole([size; 2]), Band::whole(size), clear);
    recorder.gl.set_pipeline_state(PipelineState { depth_write: true, ..PipelineState::default() });
    for (blend_mode, program) in
        [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend].into_iter().zip(&buffers.programs.shadow)
    {
        let Some(program) = program else { continue };
        program.bind(None);
        set_layer(program, map, layer);
        draw_double_sided(recorder.gl, buffers, TriangleDraw { blend_mode, program, triangles, range });
    }
    if buffers.cull_resources.is_some() {
        recorder.add_to_stats(Pass::ShadowCull);
    }
    recorder.finish(Pass::Shadow)
}

/// Bands of a layer of the map that [`blur`] blurs without a break, of at most `max_texels` texels.
pub(crate) fn blur_bands(map: &ShadowMap, max_texels: u64) -> Vec<Band> {
    let size = map.shadow.size;
    let alignment = match &map.blurred {
        Some(BlurredMoments { horizontal: None, .. }) => texels_per_workgroup(&map.shadow)[1],
        Some(BlurredMoments { framebuffers, .. }) if framebuffers.is_empty() => TEXELS_PER_INVOCATION,
        // Fragment passes are for measurements.
        _ => return vec![Band::whole(size)],
    };
    Band::divide_aligned([size; 2], max_texels, alignment)
}

/// Blurs the moments of the depth in a band of a layer. Does nothing for maps without moments.
pub(crate) fn blur(recorder: &mut PassRecorder<'_>, buffers: &SceneBuffers, layer: u32, band: Band) -> Result<()> {
    let Some(map) = &buffers.shadow else { return Ok(()) };
    let Some(blurred) = &map.blurred else { return Ok(()) };
    let gl = recorder.gl;
    let mut programs: Vec<&Program> = buffers.programs.blur.iter().map(AsRef::as_ref).collect();
    recorder.begin(Pass::Blur);
    // If the compute rasterizer drew the depth, a program that reads the depth from a buffer replaces the first one.
    let raster_input = buffers.shadow_rasterizer().and_then(ComputeRasterizer::blur_input);
    map.set_depth_copied(raster_input.is_some());
    if let (Some((depths, buffer_program)), Some(first_program)) = (raster_input, programs.first_mut()) {
        *first_program = buffer_program;
        depths.bind_storage(WORDS_BINDING);
        if let Some(copy) = map.depth_copy() {
            copy.bind_image_layer(DEPTH_COPY_IMAGE, layer);
        }
    }
    match (programs.as_slice(), &blurred.horizontal) {
        // One compute pass blurs in both directions.
        ([program], None) => {
            let [columns, rows] = texels_per_workgroup(&map.shadow);
            bind_blur(program, &map.depth, map, layer);
            program.set_first_row(band.first_row);
            blurred.moments.bind_image_layer(DESTINATION_IMAGE, layer);
            gl.dispatch(map.shadow.size.div_ceil(columns), band.rows.div_ceil(rows));
        }
        // Two compute passes.
        ([x_program, y_program], Some(horizontal)) if blurred.framebuffers.is_empty() => {
            let (size, invocations_per_row) = (map.shadow.size, map.shadow.size.div_ceil(TEXELS_PER_INVOCATION));
            // The blur in y also reads the rows around the band.
            let first_row = band.first_row.saturating_sub(map.shadow.blur_radius());
            let end_row = (band.first_row + band.rows + map.shadow.blur_radius()).min(size);
            // Wait until the previous band has read `horizontal`.
            recorder.barrier_within_pass(Pass::Blur);
            bind_blur(x_program, &map.depth, map, layer);
            x_program.set_first_row(first_row);
            horizontal.bind_image(DESTINATION_IMAGE);
            gl.dispatch(invocations_per_row.div_ceil(WORKGROUP_SIZE), end_row - first_row);
            recorder.barrier_within_pass(Pass::Blur);
            bind_blur(y_program, horizontal, map, layer);
            y_program.set_first_row(band.first_row);
            blurred.moments.bind_image_layer(DESTINATION_IMAGE, layer);
            gl.dispatch(size.div_ceil(WORKGROUP_SIZE), band.rows.div_ceil(TEXELS_PER_INVOCATION));
        }
        // Two fragment passes. Framebuffer 0 is that of `horizontal`; framebuffer 1 + i is that of layer i of
        // `moments`.
        ([x_program, y_program], Some(horizontal)) => {
            gl.set_pipeline_state(PipelineState::default());
            let framebuffers = [&blurred.framebuffers[0], &blurred.framebuffers[1 + layer as usize]];
            for ((program, source), framebuffer) in
                [(x_program, &map.depth), (y_program, horizontal)].into_iter().zip(framebuffers)
            {
                bind_blur(program, source, map, layer);
                gl.draw_fullscreen_triangle(framebuffer, map.shadow.size, &buffers.empty_vertex_array);
            }
        }
        _ => return Err(fault_in(Pass::Blur.name())("the blur programs do not match the shadow map")),
    }
    recorder.finish(Pass::Blur)
}

/// Binds a blur program and its input, and sets the layer.
fn bind_blur(program: &Program, source: &Texture, map: &ShadowMap, layer: u32) {
    program.bind(None);
    source.bind(SOURCE_UNIT);
    set_layer(program, map, layer);
}

/// Sets the layer of the bound program. The uniform exists only if the map is split.
fn set_layer(program: &Program, map: &ShadowMap, layer: u32) {
    if map.shadow.cascades > 1 {
        program.set_layer(layer);
    }
}
