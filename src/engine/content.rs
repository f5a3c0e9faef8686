//! Content of a scene that clients fetch and cache by its SHA-256: the arrays of shapes and the pixels of textures.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use modalcast_model::domain::Shape;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// A SHA-256 hash.
pub type ContentHash = [u8; 32];

/// Parses a hash from a request.
///
/// # Errors
/// `Invalid` with `field` unless there are 32 bytes.
pub fn parse_hash(field: &str, bytes: &[u8]) -> Result<ContentHash> {
    bytes.try_into().map_err(|_| invalid(field, "32 bytes", format!("{} bytes", bytes.len())))
}

/// The bytes as lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Bytes that are hashed at a time. Rows of U are copied in pieces of this size.
const HASH_CHUNK_BYTES: usize = 1 << 20;

/// An array of a shape. All numbers are little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShapeArray {
    /// u32 corner indices, three per triangle.
    Indices,
    /// u32 vertex of each corner.
    CornerVertices,
    /// f32 rest positions, three per vertex.
    RestPositions,
    /// f32 texture coordinates, two per corner; empty if the shape has none.
    Uvs,
    /// f32 rest normals, three per corner.
    RestNormals,
    /// f32 entries of U, row-major 3n x r.
    Modes,
    /// f32 rest positions relative to the origin of the shape; empty if the shape has no origin.
    CenteredPositions,
}

impl ShapeArray {
    pub const ALL: [Self; 7] = [
        Self::Indices,
        Self::CornerVertices,
        Self::RestPositions,
        Self::Uvs,
        Self::RestNormals,
        Self::Modes,
        Self::CenteredPositions,
    ];

    /// Size of the array in bytes.
    pub fn size(self, shape: &Shape) -> usize {
        match self {
            Self::Modes => size_of_val(shape.modes.columns()),
            Self::RestPositions => size_of_val(shape.mesh.rest_positions()),
            _ => self.stored_bytes(shape).len(),
        }
    }

    /// A range of bytes of the array of a shape. It is shared with the scene, except for the modes, which are stored in
    /// another order, and for the rest positions of a shape with an origin. The range must lie within the size of the
    /// array.
    pub fn read(self, scene: &Arc<Scene>, shape: usize, range: Range<usize>) -> Bytes {
        match self {
            Self::Modes => read_modes(&scene.shapes[shape], range),
            Self::RestPositions if scene.shapes[shape].is_centered() => read_positions(&scene.shapes[shape], range),
            _ => share(scene, SceneContent::Array { shape, array: self }, range),
        }
    }

    /// The bytes of an array that is stored as it is sent; empty for the modes, which are stored by columns, and for
    /// the rest positions of a shape with an origin.
    fn stored_bytes(self, shape: &Shape) -> &[u8] {
        let corners = shape.mesh.corners();
        match self {
            Self::Indices => bytemuck::cast_slice(shape.mesh.triangles()),
            Self::CornerVertices => bytemuck::cast_slice(&corners.vertices),
            Self::CenteredPositions if shape.is_centered() => bytemuck::cast_slice(shape.mesh.rest_positions()),
            Self::RestPositions if !shape.is_centered() => bytemuck::cast_slice(shape.mesh.rest_positions()),
            Self::RestPositions | Self::CenteredPositions => &[],
            Self::Uvs => bytemuck::cast_slice(&corners.uvs),
            Self::RestNormals => bytemuck::cast_slice(&corners.normals),
            Self::Modes => &[],
        }
    }
}

/// Bytes that keep their scene in memory.
struct SharedContent {
    scene: Arc<Scene>,
    content: SceneContent,
}

impl AsRef<[u8]> for SharedContent {
    fn as_ref(&self) -> &[u8] {
        match self.content {
            SceneContent::Array { shape, array } => array.stored_bytes(&self.scene.shapes[shape]),
            SceneContent::Texture(texture) => self.scene.textures[texture].rgba(),
        }
    }
}

fn share(scene: &Arc<Scene>, content: SceneContent, range: Range<usize>) -> Bytes {
    Bytes::from_owner(SharedContent { scene: Arc::clone(scene), content }).slice(range)
}

/// A range of bytes of x0 in f32, for a shape with an origin.
fn read_positions(shape: &Shape, range: Range<usize>) -> Bytes {
    let first_number = range.start / 4;
    let numbers = first_number..range.end.div_ceil(4);
    let (positions, origin) = (shape.mesh.rest_positions().as_flattened(), shape.origin());
    let x0 = |number: usize| (f64::from(positions[number]) + origin[number % 3]) as f32;
    let bytes: Vec<u8> = numbers.map(x0).flat_map(f32::to_le_bytes).collect();
    Bytes::from(bytes).slice(range.start - 4 * first_number..range.end - 4 * first_number)
}

/// Copies a range of bytes of U in row-major order.
fn read_modes(shape: &Shape, range: Range<usize>) -> Bytes {
    let (rank, rows) = (shape.modes.rank(), 3 * shape.modes.vertices());
    let columns = shape.modes.columns();
    let first_entry = range.start / 4;
    let entries = first_entry..range.end.div_ceil(4);
    let bytes: Vec<u8> =
        entries.map(|entry| columns[entry % rank * rows + entry / rank]).flat_map(f32::to_le_bytes).collect();
    Bytes::from(bytes).slice(range.start - 4 * first_entry..range.end - 4 * first_entry)
}

/// One array or texture of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneContent {
    /// `shape` is an index into the scene's shapes.
    Array { shape: usize, array: ShapeArray },
    /// The RGBA8 pixels of a texture, by its index in the scene.
    Texture(usize),
}

impl SceneContent {
    /// Size of the content in bytes.
    pub fn size(self, scene: &Scene) -> usize {
        match self {
            Self::Array { shape, array } => array.size(&scene.shapes[shape]),
            Self::Texture(texture) => scene.textures[texture].rgba().len(),
        }
    }

    /// A range of bytes of the content, as [`ShapeArray::read`] returns it. The range must lie within the size of the
    /// content.
    pub fn read(self, scene: &Arc<Scene>, range: Range<usize>) -> Bytes {
        match self {
            Self::Array { shape, array } => array.read(scene, shape, range),
            Self::Texture(_) => share(scene, self, range),
        }
    }

    fn hash(self, scene: &Arc<Scene>) -> ContentHash {
        let mut hasher = Sha256::new();
        let size = self.size(scene);
        for start in (0..size).step_by(HASH_CHUNK_BYTES) {
            hasher.update(self.read(scene, start..size.min(start + HASH_CHUNK_BYTES)));
        }
        hasher.finalize().into()
    }
}

/// The hashes of all arrays and textures of a scene.
#[derive(Debug)]
pub struct ContentHashes {
    /// Per shape, the hash of each array in the order of [`ShapeArray::ALL`].
    arrays: Vec<[ContentHash; ShapeArray::ALL.len()]>,
    textures: Vec<ContentHash>,
    /// The first content with each hash. Contents with equal hashes have equal bytes.
    content_by_hash: HashMap<ContentHash, SceneContent>,
}

impl ContentHashes {
    /// Hashes all content of a scene. Takes time in proportion to its size.
    pub(super) fn of_scene(scene: &Arc<Scene>) -> Self {
        let mut content_by_hash = HashMap::new();
        let mut hash = |content: SceneContent| {
            let hash = content.hash(scene);
            content_by_hash.entry(hash).or_insert(content);
            hash
        };
        let arrays = (0..scene.shapes.len())
            .map(|shape| ShapeArray::ALL.map(|array| hash(SceneContent::Array { shape, array })))
            .collect();
        let textures = (0..scene.textures.len()).map(|texture| hash(SceneContent::Texture(texture))).collect();
        Self { arrays, textures, content_by_hash }
    }

    /// The hash of each array of a shape, in the order of [`ShapeArray::ALL`].
    pub fn of_shape(&self, shape: usize) -> &[ContentHash; ShapeArray::ALL.len()] {
        &self.arrays[shape]
    }

    /// The hash of a texture's pixels.
    pub fn of_texture(&self, texture: usize) -> &ContentHash {
        &self.textures[texture]
    }

    /// The content with this hash, if the scene has one.
    pub fn find(&self, hash: &ContentHash) -> Option<SceneContent> {
        self.content_by_hash.get(hash).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing::two_strips;

    #[test]
    fn modes_are_read_by_rows_in_any_range() {
        let scene = two_strips();
        let shape = &scene.shapes[0];
        let modes = &shape.modes;
        let rows = (0..12).flat_map(|row| (0..2).map(move |mode| modes.column(mode)[row]));
        let expected: Vec<u8> = rows.flat_map(f32::to_le_bytes).collect();
        assert_eq!(ShapeArray::Modes.size(shape), expected.len());
        for range in [0..96, 5..6, 3..90, 96..96] {
            assert_eq!(ShapeArray::Modes.read(&scene, 0, range.clone()), expected[range.clone()], "{range:?}");
        }
    }

    #[test]
    fn every_hash_finds_content_with_its_bytes() {
        let scene = two_strips();
        let hashes = ContentHashes::of_scene(&scene);
        for (array, hash) in ShapeArray::ALL.into_iter().zip(hashes.of_shape(0)) {
            let content = hashes.find(hash).expect("expected known content");
            let bytes = array.read(&scene, 0, 0..array.size(&scene.shapes[0]));
            assert_eq!(content.read(&scene, 0..content.size(&scene)), bytes, "{array:?}");
            assert_eq!(hash[..], Sha256::digest(&bytes)[..], "{array:?}");
        }
        assert_eq!(hashes.find(&[0; 32]), None);
    }
}
