//! Vertices in memory that OpenGL shares with a deformer. At the beginning of a frame, OpenGL copies them to the vertex
//! buffers of the scene, so that the deformer can write the memory again while the frame is drawn.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

use crate::device::gl::{Buffer, Fence, Gl, MemoryBarriers, Program};
use crate::layout::WORKGROUP_SIZE;
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::{ExportedVertices, ImportedVertices, VertexImporter};

const STAGE: &str = "shared vertices";
/// Time limit of a wait for a copy, which the device executes after the frames before it.
const COPY_TIMEOUT: Duration = Duration::from_secs(60);
/// Maximum number of workgroups in x, which every context supports.
const MAX_WORKGROUPS_X: u32 = 65_535;
/// Binding of the storage buffer that is copied.
const SOURCE_BINDING: u32 = 0;
/// Binding of the storage buffer that receives the copy.
const DESTINATION_BINDING: u32 = 1;

/// The vertex buffers of a scene, as destinations of copies from shared memory.
#[derive(Debug)]
pub(crate) struct SceneVertices {
    gl: Rc<Gl>,
    /// Copies words from one buffer to another.
    copy_words: Rc<Program>,
    /// Positions, normals and, if the scene has them, tangents.
    destinations: Rc<[Buffer]>,
}

/// Shared memory with the vertices of one step.
#[derive(Debug)]
struct SharedVertices {
    gl: Rc<Gl>,
    copy_words: Rc<Program>,
    destinations: Rc<[Buffer]>,
    memory: Buffer,
    /// Offset of each attribute in `memory`.
    offsets: Vec<u64>,
    /// Fence after the last copy; `None` before the first copy, and when it is known to be signaled.
    copied: RefCell<Option<Fence>>,
}

impl SceneVertices {
    pub(crate) fn new(gl: &Rc<Gl>, copy_words: Rc<Program>, destinations: Vec<Buffer>) -> Self {
        Self { gl: Rc::clone(gl), copy_words, destinations: destinations.into() }
    }
}

impl VertexImporter for SceneVertices {
    fn import(&self, vertices: ExportedVertices) -> Result<Box<dyn ImportedVertices>> {
        let ExportedVertices { descriptor, allocated_bytes, ranges } = vertices;
        let lengths: Vec<u64> = ranges.iter().map(|range| range.end - range.start).collect();
        let expected: Vec<u64> = self.destinations.iter().map(|buffer| buffer.bytes).collect();
        if lengths != expected {
            return Err(fault(STAGE, format!("expected attributes of {expected:?} bytes, got {lengths:?}")));
        }
        let bytes = ranges.iter().map(|range| range.end).max().unwrap_or(0);
        let _current = self.gl.make_current()?;
        Ok(Box::new(SharedVertices {
            memory: Buffer::import(&self.gl, descriptor, allocated_bytes, bytes)?,
            gl: Rc::clone(&self.gl),
            copy_words: Rc::clone(&self.copy_words),
            destinations: Rc::clone(&self.destinations),
            offsets: ranges.iter().map(|range| range.start).collect(),
            copied: RefCell::default(),
        }))
    }
}

impl SharedVertices {
    /// Submits the copies of all attributes.
    fn copy(&self) {
        // Earlier draws have read the destinations, and later commands read them in several ways.
        let all_readers = MemoryBarriers::VERTEX_ATTRIBUTES
            | MemoryBarriers::TEXTURE_FETCH
            | MemoryBarriers::BUFFER_UPDATE
            | MemoryBarriers::SHADER_STORAGE;
        self.gl.barrier(all_readers);
        for (destination, offset) in self.destinations.iter().zip(&self.offsets) {
            let words = (destination.bytes / 4) as u32;
            self.copy_words.bind(Some(words));
            self.memory.bind_storage_range(SOURCE_BINDING, *offset, destination.bytes);
            destination.bind_storage(DESTINATION_BINDING);
            let workgroups = words.div_ceil(WORKGROUP_SIZE);
            let columns = workgroups.clamp(1, MAX_WORKGROUPS_X);
            self.gl.dispatch(columns, workgroups.div_ceil(columns));
        }
        self.gl.barrier(all_readers);
    }
}

impl ImportedVertices for SharedVertices {
    fn copy_to_scene(&self) -> Result<()> {
        let _current = self.gl.make_current()?;
        self.copy();
        self.copied.replace(Some(self.gl.fence(STAGE)?));
        self.gl.check(STAGE)
    }

    fn is_copied(&self) -> bool {
        let mut copied = self.copied.borrow_mut();
        let is_copied = copied.as_ref().is_none_or(Fence::is_done);
        if is_copied {
            *copied = None;
        }
        is_copied
    }

    fn wait_for_copy(&self) -> Result<()> {
        let fence = self.copied.borrow_mut().take();
        fence.map_or(Ok(()), |fence| fence.wait(STAGE, COPY_TIMEOUT))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::gl;
    use crate::resources::programs::ProgramCache;
    use crate::shaders;
    use crate::{DevicePreference, device};

    /// The first attribute needs more than one row of workgroups, the second one has three words.
    #[test]
    fn words_of_each_attribute_are_copied_from_their_offsets() {
        let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
        let program = ProgramCache::new(&gl).program(shaders::copy_words()).expect("compiles");
        let lengths = [4 * u64::from(MAX_WORKGROUPS_X * WORKGROUP_SIZE + 77), 12];
        let words = (lengths[0] + 256 + lengths[1]) / 4;
        let source: Vec<u32> = (0..words as u32).map(|word| word.wrapping_mul(0x9e37_79b9)).collect();
        let buffer = |bytes| gl.buffer(bytes, gl::STREAM_COPY, None).expect("a buffer");
        let offset = lengths[0].next_multiple_of(256);
        let memory = buffer(offset + lengths[1]);
        memory.write(&bytemuck::cast_slice(&source)[..(offset + lengths[1]) as usize]);
        let destinations: Vec<Buffer> = lengths.iter().map(|bytes| buffer(*bytes)).collect();
        let vertices = SharedVertices {
            gl: Rc::clone(&gl),
            copy_words: program,
            destinations: destinations.into(),
            memory,
            offsets: vec![0, offset],
            copied: RefCell::default(),
        };
        assert!(vertices.is_copied(), "expected no copy before the first one");
        vertices.copy_to_scene().expect("copies");
        vertices.wait_for_copy().expect("a finished copy");
        assert!(vertices.is_copied());
        for (destination, begin) in vertices.destinations.iter().zip([0, offset]) {
            let copied = destination.read(destination.bytes as usize).expect("readable");
            let expected = &bytemuck::cast_slice::<u32, u8>(&source)[begin as usize..][..copied.len()];
            assert!(copied == expected, "the attribute at {begin}");
        }
    }

    #[test]
    fn attributes_of_other_sizes_are_not_imported() {
        let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
        let program = ProgramCache::new(&gl).program(shaders::copy_words()).expect("compiles");
        let buffer = |bytes| gl.buffer(bytes, gl::STREAM_COPY, None).expect("a buffer");
        let scene = SceneVertices::new(&gl, program, vec![buffer(24), buffer(12)]);
        let descriptor = || std::fs::File::open("/dev/zero").expect("a file").into();
        for ranges in [vec![0..12, 256..268], vec![0..24, 256..268, 512..528], vec![]] {
            let vertices = ExportedVertices { descriptor: descriptor(), allocated_bytes: 4096, ranges };
            let error = scene.import(vertices).expect_err("other sizes").to_string();
            assert!(error.contains("expected attributes of [24, 12] bytes"), "{error}");
        }
        let ranges = vec![0..24, 256..268];
        let vertices = ExportedVertices { descriptor: descriptor(), allocated_bytes: 256, ranges };
        scene.import(vertices).expect_err("expected an error for memory that is too small");
        gl.check("test").expect("no error of OpenGL");
    }
}
