//! Order-independent transparency by a list of the blended fragments of each pixel. It is exact if all fragments fit
//! the memory budget. Otherwise, each pixel stores at most `per_pixel_limit` fragments: the nearest ones.
//!
//! One pass counts the fragments, a prefix sum allocates a list for each pixel, and another pass fills the lists in any
//! order. For pixels with more fragments than the limit, the first phase of the fill pass stores only depths, and a
//! second phase adds the ids. The lists are sorted by depth and id before blending, so the image does not depend on the
//! order of the fragments.

use super::draw::{GroupPart, bind_shadow, groups_of, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{Buffer, BufferCopy, ClearOp, Gl, PipelineState};
use crate::layout::cull::command_offset;
use crate::layout::oit::{
    BLEND_LAYERS_IMAGE, COMMANDS_OFFSET, COUNTERS_BYTES, HISTOGRAM_TILE, OIT_HEADER_BYTES, OitCounters, PHASE_COUNT,
    PHASE_FILL, PHASE_FILL_IDS, RECORD_BYTES,
};
use crate::layout::{EMPTY_TILE_LIST, TILE};
use crate::pass::Pass;
use crate::pieces::PieceRange;
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

/// Sets the triangles of an indirect draw command at this byte of a buffer. Keeps the number of instances, which is its
/// second word.
fn set_indirect_range(commands: &Buffer, command: usize, triangles: PieceRange) {
    let [index_count, first_index] = [triangles.count(), triangles.first].map(|number| 3 * number as u32);
    commands.write_at(command as u64, bytemuck::bytes_of(&index_count));
    commands.write_at(command as u64 + 8, bytemuck::bytes_of(&first_index));
}

/// Exact transparency of a frame. The calls of a frame are: [`Self::count`] for each band, [`Self::sum_counts`], then for
/// each band [`Self::allocate`], [`Self::fill`], [`Self::fill_ids`] and [`Self::resolve`]. Several calls of `count`,
/// `fill` or `fill_ids` draw consecutive ranges of all blended triangles. Fragments behind opaque triangles are
/// discarded.
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

    /// Counts the fragments of blended triangles in a band. The first call resets the counters.
    pub(crate) fn count(&self, recorder: &mut PassRecorder<'_>, band: Band, range: PieceRange) -> Result<()> {
        recorder.begin(Pass::OitCount);
        if range.first <= self.buffers.triangle_range(BlendMode::Blend).first {
            if band.first_row == 0 {
                reset_counters(recorder.gl, self.buffers, self.target);
            }
            let clear = ClearOp::Uint(&self.target.dirty_region);
            recorder.gl.begin_pass(&self.target.counts_fbo, self.region, band, clear);
        }
        self.target.bind();
        self.gather(recorder, band, range, PHASE_COUNT);
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

    /// Allocates the lists of a band.
    pub(crate) fn allocate(&self, recorder: &mut PassRecorder<'_>, band: Band) -> Result<()> {
        let Self { target, programs, region, .. } = *self;
        recorder.begin(Pass::OitAllocate);
        target.tile_list.write(bytemuck::cast_slice(&EMPTY_TILE_LIST));
        target.bind();
        programs.allocate.bind(None);
        programs.allocate.set_first_row(band.first_row);
        recorder.gl.dispatch(region.frame_size()[0].div_ceil(TILE), band.rows.div_ceil(TILE));
        recorder.finish(Pass::OitAllocate)
    }

    /// Stores fragments in the lists of a band. Of a pixel with more fragments than the limit, only depths.
    pub(crate) fn fill(&self, recorder: &mut PassRecorder<'_>, band: Band, range: PieceRange) -> Result<()> {
        recorder.begin(Pass::OitFill);
        self.target.bind();
        self.gather(recorder, band, range, PHASE_FILL);
        recorder.finish(Pass::OitFill)
    }

    /// Stores the ids of the fragments of which [`Self::fill`] has stored only depths.
    pub(crate) fn fill_ids(&self, recorder: &mut PassRecorder<'_>, band: Band, range: PieceRange) -> Result<()> {
        recorder.barrier_within_pass(Pass::OitFill);
        self.target.bind();
        self.gather(recorder, band, range, PHASE_FILL_IDS);
        recorder.finish(Pass::OitFill)
    }

    /// Sorts, shades and blends the lists of a range of the tiles of a band.
    pub(crate) fn resolve(&self, recorder: &mut PassRecorder<'_>, tiles: PieceRange) -> Result<()> {
        let Self { buffers, target, programs, .. } = *self;
        recorder.begin(Pass::OitResolve);
        target.bind();
        bind_shadow(buffers);
        target.blend_layers.bind_image(BLEND_LAYERS_IMAGE);
        programs.resolve.bind(None);
        programs.resolve.set_first_tile(tiles.first as u32);
        if tiles == PieceRange::ALL {
            recorder.gl.dispatch_indirect(&target.tile_list);
        } else {
            // The list may have fewer tiles.
            recorder.gl.dispatch(tiles.count() as u32, 1);
        }
        recorder.finish(Pass::OitResolve)
    }

    /// Draws blended triangles in one phase. `PHASE_FILL_IDS` is needed only if the fragments exceed the budget.
    /// Therefore it is drawn indirectly: the allocate program sets its number of instances to 1 if it is needed, else
    /// to 0.
    fn gather(&self, recorder: &mut PassRecorder<'_>, band: Band, range: PieceRange, phase: i32) {
        let Self { buffers, target, programs, region } = *self;
        let (gl, triangles) = (recorder.gl, triangle_set(buffers));
        let culled_vertex_array = buffers.visible_draws(BlendMode::Blend).map(|(vertex_array, _)| vertex_array);
        let Some(vertex_array) = culled_vertex_array.or_else(|| buffers.vertex_array(BlendMode::Blend)) else { return };
        gl.begin_pass(&target.depth_fbo, region, band, ClearOp::Load);
        for (command_index, (group_index, group)) in groups_of(buffers, BlendMode::Blend).enumerate() {
            let Some(part) = GroupPart::new(group_index, group, triangles, range) else { continue };
            gl.set_pipeline_state(PipelineState { cull_back_faces: !group.double_sided, ..PipelineState::default() });
            programs.gather.bind(Some(part.first_triangle()));
            programs.gather.set_phase(phase);
            if phase == PHASE_FILL_IDS {
                let command = COMMANDS_OFFSET + size_of::<[u32; 5]>() * command_index;
                if !part.is_whole() {
                    set_indirect_range(&target.counters, command, part.range());
                }
                gl.draw_indexed_indirect(vertex_array, &target.counters, command);
            } else {
                part.draw(gl, buffers);
            }
            recorder.stats.draw_calls += 1;
        }
    }
}
