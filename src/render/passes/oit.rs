//! Order-independent transparency by a list of the blended fragments of each pixel. It is exact if all fragments fit
//! the memory budget. Otherwise, each pixel stores at most `per_pixel_limit` fragments: the nearest ones.
//!
//! One pass counts the fragments, a prefix sum allocates a list for each pixel, and another pass fills the lists in any
//! order. For pixels with more fragments than the limit, the first phase of the fill pass stores only depths, and a
//! second phase adds the ids. The lists are sorted by depth and id before blending, so the image does not depend on the
//! order of the fragments.

use super::draw::{bind_shadow, draw_group, first_triangle_of, groups_of, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{BufferCopy, ClearOp, Gl, PipelineState};
use crate::layout::cull::command_offset;
use crate::layout::oit::{
    BLEND_LAYERS_IMAGE, COMMANDS_OFFSET, COUNTERS_BYTES, HISTOGRAM_TILE, OIT_HEADER_BYTES, OitCounters, PHASE_COUNT,
    PHASE_FILL, PHASE_FILL_IDS, RECORD_BYTES,
};
use crate::layout::{EMPTY_TILE_LIST, TILE};
use crate::pass::Pass;
use crate::region::{Band, Region};
use crate::resources::oit::OitTarget;
use crate::resources::programs::OitPrograms;
use crate::resources::scene_buffers::SceneBuffers;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Resets the counters and the draw commands of `PHASE_FILL_IDS`. The number of records per pixel is
/// unlimited until the allocation.
fn reset_counters(gl: &Gl, buffers: &SceneBuffers, target: &OitTarget) {
    let mut commands = [[0; 5]; 2];
    for (command, (_, group)) in commands.iter_mut().zip(groups_of(buffers, BlendMode::Blend)) {
        // A `DrawElementsIndirectCommand` without instances; the allocate program sets their number.
        *command = [3 * group.triangle_count as u32, 0, 3 * group.first_triangle as u32, 0, 0];
    }
    let budget = (target.records.bytes / RECORD_BYTES) as u32;
    let header = OitCounters {
        fragment_total: [0; 2],
        max_per_pixel: 0,
        per_pixel_limit: u32::MAX,
        allocated: 0,
        budget,
        commands,
    };
    let mut bytes = vec![0; COUNTERS_BYTES];
    bytes[..OIT_HEADER_BYTES].copy_from_slice(bytemuck::bytes_of(&header));
    target.counters.write(&bytes);
    for (command_index, (group_index, _)) in groups_of(buffers, BlendMode::Blend).enumerate() {
        // With culling, only the visible triangles are drawn: copy the index count from their draw command.
        if let Some((_, visible_draws)) = buffers.visible_draws(BlendMode::Blend) {
            let target_offset = COMMANDS_OFFSET + size_of::<[u32; 5]>() * command_index;
            gl.copy(BufferCopy {
                source: visible_draws,
                source_offset: command_offset(group_index) as u64,
                target: &target.counters,
                target_offset: target_offset as u64,
                bytes: size_of::<u32>() as u64, // the index count is the first word
            });
        }
    }
}

/// Exact transparency of a frame. The calls of a frame are: [`Self::count`] for each band, [`Self::sum_counts`], then
/// [`Self::blend`] for each band. Fragments behind opaque triangles are discarded.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OitFrame<'a> {
    buffers: &'a SceneBuffers,
    target: &'a OitTarget,
    programs: &'a OitPrograms,
    region: Region,
}

impl<'a> OitFrame<'a> {
    /// `None` if the frame has no fragment lists.
    pub(crate) fn of(frame: &FrameContext<'a>) -> Option<Self> {
        let (programs, target) = (frame.programs.oit.as_ref()?, frame.target.oit.as_ref()?);
        Some(Self { buffers: frame.buffers, target, programs, region: frame.target.draw_region.get() })
    }

    /// Counts the fragments of the blended triangles in a band. The first band resets the counters.
    pub(crate) fn count(&self, recorder: &mut PassRecorder<'_>, band: Band) -> Result<()> {
        recorder.begin(Pass::OitCount);
        if band.first_row == 0 {
            reset_counters(recorder.gl, self.buffers, self.target);
        }
        recorder.gl.begin_pass(&self.target.counts_fbo, self.region, band, ClearOp::Uint(&self.target.dirty_region));
        self.target.bind();
        self.gather(recorder, band, PHASE_COUNT);
        recorder.finish(Pass::OitCount)
    }

    /// Sums the fragments of all bands, which determines the number of fragments that a pixel may store.
    pub(crate) fn sum_counts(&self, recorder: &mut PassRecorder<'_>) -> Result<()> {
        let [width, height] = self.region.frame_size();
        recorder.begin(Pass::OitAllocate);
        self.target.bind();
        self.programs.histogram.bind(None);
        recorder.gl.dispatch(width.div_ceil(HISTOGRAM_TILE), height.div_ceil(HISTOGRAM_TILE));
        recorder.finish(Pass::OitAllocate)
    }

    /// Allocates, stores and blends the fragments of a band.
    pub(crate) fn blend(&self, recorder: &mut PassRecorder<'_>, band: Band) -> Result<()> {
        let Self { buffers, target, programs, region } = *self;
        let gl = recorder.gl;
        recorder.begin(Pass::OitAllocate);
        target.tile_list.write(bytemuck::cast_slice(&EMPTY_TILE_LIST));
        target.bind();
        programs.allocate.bind(None);
        programs.allocate.set_first_row(band.first_row);
        gl.dispatch(region.frame_size()[0].div_ceil(TILE), band.rows.div_ceil(TILE));
        recorder.finish(Pass::OitAllocate)?;
        recorder.begin(Pass::OitFill);
        self.gather(recorder, band, PHASE_FILL);
        recorder.barrier_within_pass(Pass::OitFill);
        self.gather(recorder, band, PHASE_FILL_IDS);
        recorder.finish(Pass::OitFill)?;
        recorder.begin(Pass::OitResolve);
        bind_shadow(buffers);
        target.blend_layers.bind_image(BLEND_LAYERS_IMAGE);
        programs.resolve.bind(None);
        gl.dispatch_indirect(&target.tile_list);
        recorder.finish(Pass::OitResolve)
    }

    /// Draws all blended triangles in one phase. `PHASE_FILL_IDS` is needed only if the fragments exceed the budget.
    /// Therefore it is drawn indirectly: the allocate program sets its number of instances to 1 if it is needed, else
    /// to 0.
    fn gather(&self, recorder: &mut PassRecorder<'_>, band: Band, phase: i32) {
        let Self { buffers, target, programs, region } = *self;
        let (gl, triangles) = (recorder.gl, triangle_set(buffers));
        let culled_vertex_array = buffers.visible_draws(BlendMode::Blend).map(|(vertex_array, _)| vertex_array);
        let Some(vertex_array) = culled_vertex_array.or_else(|| buffers.vertex_array(BlendMode::Blend)) else { return };
        gl.begin_pass(&target.depth_fbo, region, band, ClearOp::Load);
        for (command_index, (group_index, group)) in groups_of(buffers, BlendMode::Blend).enumerate() {
            gl.set_pipeline_state(PipelineState { cull_back_faces: !group.double_sided, ..PipelineState::default() });
            programs.gather.bind(Some(first_triangle_of(group, triangles)));
            programs.gather.set_phase(phase);
            if phase == PHASE_FILL_IDS {
                gl.draw_indexed_indirect(
                    vertex_array,
                    &target.counters,
                    COMMANDS_OFFSET + size_of::<[u32; 5]>() * command_index,
                );
            } else {
                draw_group(gl, buffers, group_index, triangles);
            }
            recorder.stats.draw_calls += 1;
        }
    }
}
