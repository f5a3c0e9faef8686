//! Scene descriptions: domains, and the shapes, materials and textures that they share.

use std::collections::BTreeMap;

use bytes::Bytes;
use modalcast_proto::v1;

use crate::content::ContentHash;

/// The arrays of a shape that [`crate::Client::describe`] can fetch.
pub use modalcast_proto::v1::Array as ShapeArray;

/// How the alpha of a material is used.
pub use modalcast_proto::v1::AlphaMode;

/// The attachment of a domain to its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    pub parent: usize,
    /// `parent_from_child` at rest, row-major 3x4.
    pub parent_from_child: [f32; 12],
    /// Vertices of the parent whose displacement moves the child; empty on a rigid parent.
    pub parent_vertices: Vec<u32>,
}

/// The domain whose transform a domain follows.
#[derive(Debug, Clone, PartialEq)]
pub struct Follow {
    /// Index of the followed domain.
    pub leader: usize,
    /// The transform of the follower is that of the leader times this one, row-major 3x4.
    pub leader_from_follower: [f32; 12],
}

/// Consecutive triangles with one material. A range ends where the next one begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaterialRange {
    pub first_triangle: usize,
    /// Index into [`SceneDescription::materials`].
    pub material: usize,
}

/// One domain of a scene. Its mesh and modes are those of its shape.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Domain {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    /// Index into [`SceneDescription::shapes`].
    pub shape: usize,
    /// r, the number of modes of the shape.
    pub rank: usize,
    /// Index into [`SceneDescription::materials`]: the material of all triangles, unless there are ranges.
    pub material: usize,
    /// Ranges of triangles with different materials, ascending; empty if all triangles have `material`.
    pub material_ranges: Vec<MaterialRange>,
    pub attachment: Option<Attachment>,
    /// Steps must not contain a transform of a domain that follows another one.
    pub follow: Option<Follow>,
    /// `world_from_domain` at rest, row-major 3x4.
    pub placement: [f32; 12],
    /// `placement` in f64. Differs from it only if the domain is far from the scene's origin.
    pub exact_placement: [f64; 12],
    /// q at rest: r numbers, or none if all are 0.
    pub rest_q: Vec<f32>,
    /// Index in the scene of an earlier domain, with which this domain shares its coordinates.
    pub shares_q_with: Option<usize>,
    /// (rad/s)^2, one per mode; empty when unknown.
    pub eigenvalues: Vec<f64>,
    /// Mass properties of the domain's own material; `None` if unknown.
    pub inertia: Option<Inertia>,
    /// Free-form metadata of the scene's author, by name.
    pub notes: BTreeMap<String, String>,
}

/// Mass properties of the material of a domain, without the domains that are attached to it. The kinetic energy of a
/// domain that moves by R X + U q is 1/2 [X', q']^T [[R^T M R, R^T M U], [U^T M R, U^T M U]] [X', q']. X is the small motion of
/// the domain's frame in its own axes (translation of its origin, then rotation vector), and R are the rigid motions about
/// the origin.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Inertia {
    /// kg.
    pub mass: f64,
    /// Center of mass at rest, in the frame of the domain and scene units.
    pub center: [f64; 3],
    /// Entries xx, yy, zz, xy, xz, yz of the inertia tensor about the frame's origin, kg scene units^2.
    pub moments: [f64; 6],
    /// R^T M U, 6 x r row-major.
    pub modal_momenta: Vec<f64>,
    /// U^T M U, r x r row-major.
    pub modal_masses: Vec<f64>,
}

/// A mesh of n vertices and its r modes. Arrays that were not requested are empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Shape {
    /// Index in the scene.
    pub index: usize,
    /// n, the number of vertices: U has 3n rows.
    pub vertex_count: usize,
    /// r, the number of modes: U has r columns.
    pub rank: usize,
    /// Number of corners. A corner is a vertex with one normal and one pair of texture coordinates; a vertex may have
    /// several corners.
    pub corner_count: usize,
    pub triangle_count: usize,
    /// Hashes of the arrays, if hashes were requested.
    pub hashes: Vec<(ShapeArray, ContentHash)>,
    /// Corner indices, three per triangle.
    pub indices: Vec<u32>,
    /// Vertex of each corner. Vertex v has the rows 3v, 3v + 1 and 3v + 2 of U.
    pub corner_vertices: Vec<u32>,
    /// Three numbers per vertex, in the frame of the domain.
    pub rest_positions: Vec<f32>,
    /// Texture coordinates, two per corner.
    pub uvs: Vec<f32>,
    /// Three numbers per corner, in the frame of the domain.
    pub rest_normals: Vec<f32>,
    /// U: 3n x r entries, row-major.
    pub modes: Vec<f32>,
    /// c, the point that `centered_positions` are relative to, in scene units and in the frame of the domain. Zero
    /// unless f32 would round x0 too coarsely.
    pub origin: [f64; 3],
    /// x0 - c, three numbers per vertex; empty if the shape has no origin.
    pub centered_positions: Vec<f32>,
}

/// A Phong material. Colors are linear.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Material {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    pub ambient: [f32; 3],
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    /// Phong exponent.
    pub shininess: f32,
    pub alpha: f32,
    pub alpha_mode: AlphaMode,
    /// With [`AlphaMode::Mask`], fragments with a smaller alpha are not drawn.
    pub alpha_cutoff: f32,
    pub double_sided: bool,
    /// Index into [`SceneDescription::textures`]: sRGB colors that multiply ambient and diffuse, and alpha.
    pub color_texture: Option<usize>,
    /// Index into [`SceneDescription::textures`]: a tangent-space normal map with linear values.
    pub normal_texture: Option<usize>,
}

/// An image of RGBA8 pixels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Texture {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    pub width: u32,
    pub height: u32,
    /// Hash of the pixels, if hashes were requested.
    pub hash: Option<ContentHash>,
    /// Four bytes per pixel, top row first; empty unless [`crate::DescriptionRequest::textures`] was set.
    pub pixels: Bytes,
}

/// A scene, and the shapes, materials and textures of the described domains, each once.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneDescription {
    pub info: v1::SceneInfo,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
}

impl SceneDescription {
    /// The shape of a domain of this description.
    pub fn shape_of(&self, domain: &Domain) -> &Shape {
        &self.shapes[domain.shape]
    }
}
